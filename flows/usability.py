"""Usability of a run: whether its results can be used, and with which reservations.

This is the one place that decides it, from what the run's units stored: their metrics, held against
`UsableLimits`, and their warnings. Pages, commands, alerts and manifests show the verdict of the
run's record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from data_contracts.run import UnitFailure
from data_contracts.usability import Usability, UsableLimits
from flows.review.metric_words import quantity

Figures = Mapping[str, float]

DOUBTING: Final = (
    "static_calibration",
    "camera_consistency",
    "tracking",
    "triangulation",
    "bundle_adjustment",
    "retriangulation",
    "body_fitting",
    "refitting",
)
"""Stages whose warnings doubt their results; those of other stages describe the inputs."""
_REPLACED: Final = {"triangulation": "retriangulation"}
"""Stage to a later one whose metrics replace its own."""


@dataclass(frozen=True)
class _Rule:
    """Metric with a limit; larger is worse.

    Attributes:
        stage: the stage of the metric.
        metric: its name; parts are `metric.part`.
        limit: name in `UsableLimits`.
        says: the reservation, with places for the unit, the value, the parts, and when.
    """

    stage: str
    metric: str
    limit: str
    says: str


_RULES: Final = (
    _Rule(
        "detection",
        "unreadable_share",
        "max_unreadable_share",
        "the video of {unit} has no image, or none that can be decoded, for {value} of the frames"
        "{when}. Check the video, and convert it with any video tool.",
    ),
    _Rule(
        "tracking",
        "absent_share",
        "max_absent_share",
        "people are missing in {unit} for {value} of the time{when}. Check the videos or 2D poses "
        "there.",
    ),
    _Rule(
        "tracking",
        "unmatched_share",
        "max_unmatched_share",
        "{value} of the detections in {unit} belong to no track. Look for people beside the pitch, "
        "or for a camera with a wrong clock or pose.",
    ),
    _Rule(
        "tracking",
        "mean_ray_distance_m",
        "max_ray_distance_m",
        "cameras disagree about the people in {unit} by {value}. Check the calibration and the "
        "clocks of the cameras.",
    ),
    _Rule(
        "triangulation",
        "standard_deviation_m",
        "max_standard_deviation_m",
        "joints in {unit} are uncertain by {value}. More cameras, or better calibrated ones, have "
        "to see the people.",
    ),
    _Rule(
        "triangulation",
        "unhealthy_s",
        "max_unhealthy_s",
        "the keypoints of {part} depart from the people in {unit}, or its images are bad, for "
        "{value} at a time{when}. Look at the video there.",
    ),
    _Rule(
        "triangulation",
        "misplacement_m",
        "max_misplacement_m",
        "the calibration of {part} displaces people in {unit} by {value}. Click more markings, "
        "where there are none.",
    ),
    _Rule(
        "bundle_adjustment",
        "moved_deviations",
        "max_moved_deviations",
        "the people contradict the calibration of {part}: the adjustment moves it by {value} "
        "standard deviations. Check its clicks, and calibrate its lens.",
    ),
    _Rule(
        "body_fitting",
        "held_out_certain_excess_m",
        "max_body_excess_m",
        "bodies in {unit} are farther from the images than triangulated joints are ({part}), by "
        "{value}. Compare both with the images, or export --stage retriangulation.",
    ),
    _Rule(
        "body_fitting",
        "offset_rms_m",
        "max_body_offset_m",
        "bodies in {unit} lie {value} off the joints that cameras show. Compare both with the "
        "images, or export --stage retriangulation.",
    ),
    _Rule(
        "broadcast_calibration",
        "expected_error_median_px",
        "max_broadcast_error_px",
        "the broadcast camera of {unit} is uncertain by {value}. Click more key frames.",
    ),
)


@dataclass(frozen=True)
class RunOutcome:
    """Results of a run, as they are judged.

    Attributes:
        figures: unit, as `stage/unit`, to its metrics.
        warnings: unit to its warnings, in the order of the method.
        left_out: a sentence for each camera that is left out.
        failed: units without a result.
        lacks_results: whether no unit of the last requested stage has a result.
        lacks_people: whether no person was found, or too few cameras are left to place any.
        waiting: number of results that need review before others are computed.
    """

    figures: Mapping[str, Figures] = field(default_factory=dict)
    warnings: Mapping[str, Sequence[str]] = field(default_factory=dict)
    left_out: Sequence[str] = ()
    failed: Sequence[UnitFailure] = ()
    lacks_results: bool = False
    lacks_people: bool = False
    waiting: int = 0


def judge_run(outcome: RunOutcome, limits: UsableLimits) -> Usability:
    """Return the verdict on a run's results."""
    against = list(_reasons_against(outcome, limits))
    said = [
        *against,
        *(f"{each.unit} failed: {' '.join(each.message.split())}" for each in outcome.failed),
        *outcome.left_out,
        *exceeded_limits(outcome.figures, limits),
        *(
            text
            for name, warnings in outcome.warnings.items()
            if name.partition("/")[0] in DOUBTING
            for text in warnings
        ),
    ]
    verdict = "not usable" if against else "usable with reservations" if said else "usable"
    return Usability(verdict=verdict, reservations=tuple(dict.fromkeys(said)), limits=limits)


def exceeded_limits(figures: Mapping[str, Figures], limits: UsableLimits) -> list[str]:
    """Return a sentence for each metric beyond its limit; metrics are given by unit and name."""
    found: list[str] = []
    for rule in _RULES:
        last = _REPLACED.get(rule.stage, rule.stage)
        for name, own in figures.items():
            stage, _, unit = name.partition("/")
            if stage == last or (stage == rule.stage and f"{last}/{unit}" not in figures):
                found += _exceeding(rule, unit, own, getattr(limits, rule.limit))
    return found


def _exceeding(rule: _Rule, unit: str, figures: Figures, limit: float) -> Iterator[str]:
    """Yield the sentence of a metric of which the whole, or some parts, exceed the limit."""
    beyond = {
        name.partition(".")[2]: value
        for name, value in sorted(figures.items(), key=lambda each: -each[1])
        if name.partition(".")[0] == rule.metric and value > limit
    }
    if beyond:
        worst, value = next(iter(beyond.items()))
        yield rule.says.format(
            unit=" in ".join(unit.split(".")),
            value=f"{quantity(rule.metric, value)} (limit {quantity(rule.metric, limit)})",
            part=", ".join(beyond),
            when=_when(rule.metric.rpartition("_")[0], worst, figures),
        )


def _when(subject: str, part: str, figures: Figures) -> str:
    """Return the longest time of what a metric counts, and of which person; empty if unknown."""
    ending = f".{part}" if part else ""
    first, last = (figures.get(f"{subject}_{end}_frame{ending}") for end in ("from", "to"))
    if first is None or last is None:
        return ""
    person = figures.get(f"{subject}_person")
    whose = "" if person is None else f"person {person:.0f} "
    frames = f"frame {first:.0f}" if first == last else f"frames {first:.0f} to {last:.0f}"
    return f", longest {whose}in {frames}"


def _reasons_against(outcome: RunOutcome, limits: UsableLimits) -> Iterator[str]:
    """Yield why results cannot be used at all."""
    if outcome.lacks_results:
        yield "the run failed."
    if outcome.lacks_people:
        yield "no person is placed."
    if outcome.waiting:
        yield f"results that wait for review: {outcome.waiting}."
    most = limits.max_unusable_share
    for name, own in outcome.figures.items():
        stage, _, unit = name.partition("/")
        if stage == "tracking" and own.get("absent_share", 0.0) > most:
            share = quantity("absent_share", most)
            yield f"people are missing in {unit} for more than {share} of the time."
