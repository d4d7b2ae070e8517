"""Usability of a run: whether its results can be used, and with which reservations.

This is the one place that decides it, from what the run's units stored: their metrics, held against
`UsableLimits`, and their warnings. Pages, commands, alerts and manifests show the verdict of the
run's record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, log1p, sqrt
from typing import Final

from data_contracts.run import BODY_STAGES, UnitFailure
from data_contracts.usability import Usability, UsableLimits
from flows.gates import exceeds
from flows.layers import merge_general
from flows.review.metric_words import metric_words, point_words, quantity
from flows.stage import Match

Figures = Mapping[str, float]

DOUBTING: Final = (
    *("static_calibration", "detection", "camera_consistency", "tracking"),
    *("triangulation", "bundle_adjustment", "retriangulation", "body_fitting"),
    *("broadcast_calibration", "broadcast_tracking", "refitting"),
)
"""Stages whose warnings doubt their results; those of other stages describe the inputs."""
_REPLACED: Final = {"triangulation": "retriangulation"}
"""Stage to a later one whose metrics replace its own."""


_UNUSABLE: Final = {
    "absent_share": "people are missing in {} for {} of the time. Check the videos, or the "
    "given 2D poses.",
    "unmatched_share": "no track follows {1} of the people found in the images of {0}. The "
    "calibration or the clock of a camera is wrong, or the detector was made for other images.",
}
"""Metric of tracking to what is said where its share makes results not usable."""


@dataclass(frozen=True)
class _Rule:
    """Metric with a limit; larger is worse.

    Attributes:
        metric: its name; parts are `metric.part`.
        limit: name in `UsableLimits`; empty = a limit of zero.
        says: the reservation, with places for the unit, the value, the parts, and when.
        is_required: whether a result without the metric could not be judged.
    """

    stage: str
    metric: str
    limit: str
    says: str
    is_required: bool

    @classmethod
    def parse(cls, text: str) -> Iterator[_Rule]:
        """Yield a rule for each stage that its first line names."""
        head, _, says = text.partition("\n")
        stages, metric, limit, required, *_ = *head.split(), "", ""
        for stage in stages.split(","):
            yield cls(stage, metric, limit, " ".join(says.split()), required == "required")


_STATED: Final = """\
static_calibration expected_ground_error_median_m max_ground_error_m
the calibration of {unit} places people on the pitch only to {value}, and no joints confirm it.
Click more markings, where there are none.

static_calibration clicks_wrong
clicks of {unit} contradict the others and are not used: {value}. Correct or remove them.

detection unreadable_share max_unreadable_share
the video of {unit} has no image, or none that can be decoded, for {value} of the frames{when}.
Check the video and its offset, or convert it with any video tool.

tracking absent_share max_absent_share
people are missing in {unit} for {value} of the time{when}. Look at the videos,
or the given 2D poses, there.

tracking unmatched_share max_unmatched_share required
no track follows {value} of the people found in the images of {unit}. Look for people who take no
part, or for a camera whose clock or calibration is wrong.

tracking mean_ray_distance_m max_ray_distance_m
cameras disagree by {value} about where people are in {unit}. Check the calibration and the clocks
of the cameras.

triangulation standard_deviation_m max_standard_deviation_m required
joints in {unit} are uncertain by {value}. More cameras, or better calibrated ones, have to see the
people.

triangulation filled_share max_filled_share
no camera sees {value} of the joints in {unit}: motion alone places them. Add cameras, or check
their 2D poses.

triangulation unhealthy_s max_unhealthy_s
the keypoints of {part} depart from the people in {unit}, or its images are bad, for {value} at a
time{when}. Look at the video there.

triangulation unhealthy_share max_absent_share
the keypoints of {part} depart from the people in {unit}, or its images are bad, for {value} of the
time{when}. Look at the video there.

triangulation missed_share max_unusable_share
no detection of {part} is matched to a person of {unit} whom its images should show, for {value} of
the time{when}. Look at the people of that camera, its clock and its calibration.

triangulation misplacement_m max_misplacement_m
the calibration of {part} displaces people in {unit} by {value}. Click more markings, where there
are none.

bundle_adjustment moved_deviations max_moved_deviations
the people contradict the calibration of {part}: the adjustment moves it by {value} standard
deviations. Check its clicks, and calibrate its lens.

body_fitting held_out_certain_excess_m max_body_excess_m
bodies in {unit} are farther from the images than triangulated joints are ({part}), by {value}.
Compare both with the images, or export --stage retriangulation.

body_fitting offset_rms_m max_body_offset_m required
bodies in {unit} lie {value} off the joints that cameras show. Compare both with the images, or
export --stage retriangulation.

broadcast_calibration expected_error_median_px max_broadcast_error_px required
the broadcast camera of {unit} is uncertain by {value}. Click more key frames.

broadcast_tracking unmatched_share max_unmatched_share
no track follows {value} of the people found by the broadcast camera in {unit}. Look for people
beside the pitch, or for wrong key frames.

tracking,broadcast_tracking plane_std_m max_plane_std_m
places of people in {unit} are uncertain by {value}, where only their feet place them. Click more
markings, or more key frames of a broadcast camera.

ingest,detection,tracking corrections_refused
{value} corrections of {unit} do not fit its results and are not applied. Correct them on the page
of the match, or withdraw them, and run again."""
"""Paragraphs: stages, metric, limit, and `required`; below them what is said."""
_RULES: Final = tuple(rule for text in _STATED.split("\n\n") for rule in _Rule.parse(text))


@dataclass(frozen=True)
class RunOutcome:
    """Results of a run, as they are judged.

    Attributes:
        warnings: unit to its warnings, in the order of the method.
        lacks_results: whether no unit of the last requested stage has a result.
        lacks_people: whether no person was found, or too few cameras are left to place any.
        lacks_joints: whether no person has a joint in 3D.
        waiting: number of results that need review before others are computed.
    """

    figures: Mapping[str, Figures] = field(default_factory=dict)
    warnings: Mapping[str, Sequence[str]] = field(default_factory=dict)
    left_out: Sequence[str] = ()
    failed: Sequence[UnitFailure] = ()
    lacks_results: bool = False
    lacks_people: bool = False
    lacks_joints: bool = False
    waiting: int = 0


def usable_limits(match: Match) -> UsableLimits:
    """Return the limits that the layers of a match state for the verdict on its results."""
    stated = merge_general(match.layers).model_dump(include=set(UsableLimits.model_fields))
    return UsableLimits.model_validate(stated)


def judge_run(outcome: RunOutcome, limits: UsableLimits) -> Usability:
    """Return the verdict on a run's results."""
    against, shares = list(_reasons_against(outcome)), list(_unusable_shares(outcome, limits))
    doubts = {
        name: [each for each in texts if not each.endswith("the camera does not film this clip.")]
        for name, texts in outcome.warnings.items()
        if name.partition("/")[0] in DOUBTING
    }
    causes = [
        text for name, texts in doubts.items() if name.startswith("detection/") for text in texts
    ]
    rest = {  # a share that makes results not usable is said once
        name: {**own, **dict.fromkeys(_unusable(name, own, limits), 0.0)}
        for name, own in outcome.figures.items()
    }
    said = [
        *against,
        *causes,
        *shares,
        *(f"{each.unit} failed: {' '.join(each.message.split())}" for each in outcome.failed),
        *outcome.left_out,
        *(() if against or shares else _describe_lack(outcome)),
        *exceeded_limits(rest, limits),
        *(text for texts in doubts.values() for text in texts),
    ]
    verdict = (
        "not usable" if against or shares else "usable with reservations" if said else "usable"
    )
    return Usability(verdict=verdict, reservations=tuple(dict.fromkeys(said)), limits=limits)


def exceeded_limits(figures: Mapping[str, Figures], limits: UsableLimits) -> list[str]:
    """Return a sentence for each metric beyond its limit; metrics are given by unit and name."""
    found: list[str] = []
    was_clicked = any(
        own for name, own in figures.items() if name.startswith("static_calibration/")
    )
    figures = {name: _as_normal(own, figures, limits) for name, own in figures.items()}
    # Joints measure what errors of the cameras do to people.
    has_joints = any(own.get("joints") for own in figures.values())
    for rule in _RULES:
        if has_joints and rule.limit == "max_ground_error_m":
            continue
        last = _REPLACED.get(rule.stage, rule.stage)
        for name, own in figures.items():
            stage, _, unit = name.partition("/")
            if stage == last or (stage == rule.stage and f"{last}/{unit}" not in figures):
                limit = getattr(limits, rule.limit) if rule.limit else 0.0
                found += _exceeding(rule, " in ".join(unit.split(".")), own, limit)
    if not was_clicked:
        clicks = "Click more markings, where there are none."
        found = [text.replace(clicks, "Calibrate it anew.") for text in found]
    return found


def _as_normal(own: Figures, figures: Mapping[str, Figures], limits: UsableLimits) -> Figures:
    """Return a unit's metrics with motions of cameras in deviations of a normal error.

    Of a camera that is not healthy for too long, the share is not said, too.

    Calibration estimates the noise of a camera's clicks from these: the error over the stated
    deviation has Student's distribution. With n degrees of freedom, t deviations are as improbable
    as (Wallace 1959)

        z = (8 n + 1) / (8 n + 3) sqrt(n log(1 + t^2 / n))
    """
    normal = dict(own)
    for name, moved in own.items():
        metric, _, camera = name.partition(".")
        if metric == "moved_deviations":
            n = figures.get(f"static_calibration/{camera}", {}).get("click_freedom", 0.0)
            if n > 0.0:
                share = (8.0 * n + 1.0) / (8.0 * n + 3.0)
                normal[name] = share * sqrt(n * log1p(moved**2 / n))
        if metric == "unhealthy_s" and exceeds(moved, limits.max_unhealthy_s):
            normal.pop(f"unhealthy_share.{camera}", None)
    return normal


def _exceeding(rule: _Rule, place: str, figures: Figures, limit: float) -> Iterator[str]:
    """Yield the sentences of a metric of which the whole, or some parts, exceed the limit.

    A result without any metric was judged before the run.
    """
    own = {
        name.partition(".")[2]: value
        for name, value in figures.items()
        if name.partition(".")[0] == rule.metric and ("." in name or "{part}" not in rule.says)
    }
    nobody = 0.0 in (figures.get("joints"), figures.get("bodies"))
    unknown = [part for part, value in own.items() if not isfinite(value)]
    if unknown or (rule.is_required and figures and not own and not nobody):
        parts = f" ({', '.join(unknown)})" if any(unknown) else ""
        yield (
            f"{metric_words(rule.metric)[0]} could not be computed in {place}{parts}. Look at it "
            "in the report."
        )
    beyond = sorted(own.keys() - set(unknown), key=lambda part: (-own[part], part))
    beyond = [part for part in beyond if exceeds(own[part], limit)]
    if beyond:
        named = (name.partition(".") for name in figures if rule.metric == "clicks_wrong")
        clicks = [point_words(click) for metric, _, click in named if metric == "wrong_click"]
        yield rule.says.format(
            unit=place,
            value=quantity(rule.metric, own[beyond[0]])
            + (f" (limit {quantity(rule.metric, limit)})" if rule.limit else "")
            + (f" ({', '.join(clicks)})" if clicks else ""),
            part=", ".join(beyond),
            when=_when(rule.metric.rpartition("_")[0], beyond[0], figures),
        )


def _when(subject: str, part: str, figures: Figures) -> str:
    """Return the longest time of what a metric counts, and of which person; empty if unknown."""
    ending = f".{part}" if part else ""
    first, last = (figures.get(f"{subject}_{end}_frame{ending}") for end in ("from", "to"))
    person = figures.get(f"{subject}_person{ending}")
    if first is None or last is None:
        return "" if person is None else f", person {person:.0f} in {part}"
    whose = "" if person is None else f"person {person:.0f} "
    frames = f"frame {first:.0f}" if first == last else f"frames {first:.0f} to {last:.0f}"
    return f", longest {whose}in {frames}"


def _describe_lack(outcome: RunOutcome) -> Iterator[str]:
    """Yield that the results, in the order of the method, end before people have bodies."""
    if outcome.lacks_joints:
        yield "no person is in 3D: people have places on the pitch, without joints and bodies."
    stages = [name.partition("/")[0] for name in outcome.figures]
    if stages and not {*BODY_STAGES, "broadcast_tracking"} & {*stages}:
        yield (
            f"no person has a body: the results end with {stages[-1]}. Run the match without "
            "--until."
        )


def _reasons_against(outcome: RunOutcome) -> Iterator[str]:
    """Yield why there is nothing to use."""
    if outcome.lacks_results:
        yield "the run failed. Correct what the failed units say, and run again."
    if outcome.lacks_people:
        yield "no person is placed. Look at the videos and at the calibration of the cameras."
    if outcome.waiting:
        yield (
            f"results that wait for review: {outcome.waiting}. Decide or correct them, "
            "and run again."
        )


def _unusable_shares(outcome: RunOutcome, limits: UsableLimits) -> Iterator[str]:
    """Yield the parts of a clip without people that are too large to use the rest."""
    for name, own in outcome.figures.items():
        for metric in _unusable(name, own, limits):
            value = quantity(metric, own[metric])
            limit = quantity(metric, limits.max_unusable_share)
            place = name.partition("/")[2]
            yield _UNUSABLE[metric].format(place, f"{value} (limit {limit})")


def _unusable(name: str, own: Figures, limits: UsableLimits) -> list[str]:
    """Return the metrics of a unit that make results not usable."""
    beyond = [each for each in _UNUSABLE if own.get(each, 0.0) > limits.max_unusable_share]
    return beyond if name.startswith("tracking/") else []
