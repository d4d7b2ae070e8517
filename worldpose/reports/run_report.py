"""HTML page about a run: units, quality metrics, scores and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from data_contracts.evaluation import Evaluation
from data_contracts.run import RunRecord
from worldpose.reports.html_page import Failure, Folded, Section, Table, whole_page

MEANINGS: Final = {
    "mpjpe_mm": (
        "Mean joint error",
        "mm",
        "mean distance between estimated and true joints in world coordinates, without alignment",
    ),
    "g_mpjpe_mm": (
        "G-MPJPE",
        "mm",
        "joint error after one translation, rotation and scaling of all people's trajectories",
    ),
    "g_mpjpe_rigid_mm": ("G-MPJPE, no scaling", "mm", "the same without scaling"),
    "per_person_g_mpjpe_mm": (
        "G-MPJPE per person",
        "mm",
        "joint error after a translation, rotation and scaling of each person's trajectory",
    ),
    "per_person_g_mpjpe_rigid_mm": ("per person, no scaling", "mm", "the same without scaling"),
    "pa_mpjpe_mm": (
        "PA-MPJPE",
        "mm",
        "joint error after a translation, rotation and scaling of each person in each frame",
    ),
    "pa_mpjpe_rigid_mm": ("PA-MPJPE, no scaling", "mm", "the same without scaling"),
    "per_meter_drift_cm_per_m": (
        "Drift",
        "cm/m",
        "error of G-MPJPE per metre of a person's true path, mean over people",
    ),
    "per_meter_drift_rigid_cm_per_m": ("Drift, no scaling", "cm/m", "the same without scaling"),
    "per_person_drift_cm_per_m": (
        "Drift per person",
        "cm/m",
        "error of G-MPJPE per person, per metre of the person's true path",
    ),
    "per_person_drift_rigid_cm_per_m": (
        "Drift per person, no scaling",
        "cm/m",
        "the same without scaling",
    ),
    "g_scale": ("Scaling", "", "factor by which G-MPJPE scales the prediction; 1 is the true size"),
    "challenge_score": (
        "Challenge score",
        "m",
        "global joint error plus five times the joint error relative to the hips; without big toes",
    ),
    "challenge_global_m": ("global part of it", "m", "joint error of tracks in world coordinates"),
    "challenge_local_m": ("local part of it", "m", "joint error relative to the hips"),
    "acceleration_error_m_s2": (
        "Acceleration error",
        "m/s²",
        "difference to the true acceleration of joints: jitter or too much smoothing",
    ),
    "track_coverage": (
        "People followed",
        "%",
        "share of true people in all frames that the metrics of tracks include",
    ),
    "pcp3d": (
        "Correct limbs",
        "%",
        "limbs whose ends have a mean error of at most half the limb's length; missing ones are "
        "wrong",
    ),
    "coverage": (
        "People found",
        "%",
        "recall: share of true people in all frames with a matched prediction",
    ),
    "joint_coverage": ("Joints found", "%", "share of true joints with an estimated joint"),
    "false_persons_per_frame": (
        "False positives",
        "per frame",
        "mean number of predicted people without a true person",
    ),
    "idf1": (
        "IDF1",
        "%",
        "share of true and predicted people in all frames that have the right id",
    ),
    "hota": ("HOTA", "%", "geometric mean of detection and association accuracy"),
    "detection_accuracy": (
        "detection part of it",
        "%",
        "true positives among all true and predicted people",
    ),
    "association_accuracy": ("association part of it", "%", "how pure and complete the tracks are"),
    "switches": ("Switches", "", "times that a true person continues under another id"),
    "switches_per_minute": ("Switches", "per minute", "of the match, all people together"),
    "fragmentations": ("Fragmentations", "", "times that a track of a true person is interrupted"),
    "persons": ("True people", "", "people with enough visible joints to count"),
    "frames": ("Frames scored", "", "all frames of the reference"),
    "cameras": ("Cameras", "", "errors of the estimated cameras by kind"),
}
"""Label, unit and description of every metric; shares are shown in per cent."""

CAMERA_MEANINGS: Final = {
    "ground_error_median_m": (
        "ground error",
        "m",
        "distance on the pitch between a point and the ground position of its pixel, median",
    ),
    "ground_error_p95_m": ("ground error, 95 %", "m", "the same, 95th percentile"),
    "reprojection_error_median_px": (
        "reprojection error",
        "px",
        "distance in the image, for points at player height above the pitch, median",
    ),
    "reprojection_error_p95_px": ("reprojection error, 95 %", "px", "the same, 95th percentile"),
    "center_error_m": ("centre", "m", "distance from the true position, mean"),
    "rotation_error_deg": ("rotation", "deg", "angle to the true orientation, mean"),
    "focal_error_percent": ("focal length", "%", "difference to the true focal length, mean"),
    "coverage": ("frames", "%", "share of the frames that have an estimate"),
    "cameras": ("number", "", "cameras compared"),
}
"""Label, unit and description of every camera metric."""

SHARES: Final = (
    "coverage",
    "joint_coverage",
    "track_coverage",
    "idf1",
    "hota",
    "detection_accuracy",
    "association_accuracy",
)
"""Metrics that are shares of a whole [0..1]."""


def score_rows(scores: Evaluation) -> list[tuple[str, str, str, str]]:
    """Return name, label, value with unit, and description of every available metric."""
    figures = scores.model_dump(exclude_none=True)
    groups = figures.pop("cameras", {})
    rows = [(name, *_score_row(MEANINGS[name], name, value)) for name, value in figures.items()]
    for kind, errors in groups.items():
        for name, value in errors.items():
            label, shown, meaning = _score_row(CAMERA_MEANINGS[name], name, value)
            rows.append(
                (f"cameras.{kind}.{name}", f"{kind.capitalize()} cameras: {label}", shown, meaning)
            )
    return rows


def _score_row(meaning: tuple[str, str, str], name: str, value: float) -> tuple[str, str, str]:
    label, unit, words = meaning
    shown = format_number(100.0 * value if name in SHARES else value)
    return label, f"{shown} {unit}".strip(), words


def format_number(value: float) -> str:
    """Return a number with four digits, without exponent if possible."""
    return f"{value:,.0f}" if float(value).is_integer() or abs(value) >= 1e4 else f"{value:.4g}"


def report_page(
    title: str,
    run: RunRecord,
    *,
    seconds: Mapping[str, float],
    scores: Evaluation | None = None,
    sections: Sequence[Section] = (),
    tiles: Sequence[tuple[str, str]] = (),
) -> str:
    """Return a self-contained HTML page without external resources.

    `seconds` is the computation time of each unit, by `stage/unit` [s]; scores are metrics against
    the truth, if there is a reference.
    """
    shown = list(sections)
    usability = run.usability
    if said := dict.fromkeys((*usability.reservations, *run.warnings)):
        heading = usability.verdict.capitalize() if usability.reservations else "Warnings"
        table = Table("", ("",), tuple((Failure(text),) for text in said))
        shown.insert(0, Section(heading, (table,)))
    if scores is not None:
        rows = tuple(row[1:] for row in score_rows(scores))
        table = Table("", ("score", ">value", "what it says"), rows)
        shown.append(Section("Against the truth", (table,)))
    return whole_page(
        title,
        f"Run {run.run_id} of match {run.match_id}, {run.started_at:%d %B %Y}: {run.state}, "
        f"{usability.verdict}",
        shown,
        tiles=tiles,
        last=Folded("Record", _record(run, seconds)),
    )


def _record(run: RunRecord, seconds: Mapping[str, float]) -> tuple[Table, ...]:
    """Return tables of the run, its settings, units and quality metrics."""
    settings = ("stage", "setting", "value")
    return (
        Table("What was run", ("", ""), tuple(_about(run))),
        Table("Settings other than the defaults", settings, tuple(_settings(run))),
        Table("Units of work", ("unit", "", ">seconds"), tuple(_units(run, seconds))),
        Table("Quality metrics", ("unit", "metric", ">value"), tuple(_figures(run))),
    )


def format_scaled(value: float | None, scale: float, decimals: int) -> str:
    """Return a number times a factor with some decimals; a dash for none."""
    return "-" if value is None else f"{scale * value:,.{decimals}f}"


def _about(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        ("started", f"{run.started_at:%Y-%m-%d %H:%M:%S %Z}".strip()),
        ("took", f"{run.seconds:.1f} s"),
        ("run before it", run.parent or "none"),
        (
            "units computed, reused, failed",
            f"{len(run.executed)}, {len(run.reused)}, {len(run.failed)}",
        ),
        *((f"version of {name}", version) for name, version in run.versions.items()),
    ]


def _units(run: RunRecord, seconds: Mapping[str, float]) -> list[tuple[str, ...]]:
    failed = {failure.unit: Failure(f"failed: {failure.message}") for failure in run.failed}
    states = {
        **dict.fromkeys(run.executed, "computed"),
        **dict.fromkeys(run.reused, "reused"),
        **failed,
    }
    units = [unit for unit in (*run.results, *failed) if unit in states]
    return [
        (unit, states[unit], f"{seconds[unit]:.2f}" if unit in seconds else "") for unit in units
    ]


def _figures(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        (unit if number == 0 else "", name, format_number(value))
        for unit, figures in run.figures.items()
        for number, (name, value) in enumerate(figures.items())
    ]


def _settings(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        (stage, name, f"{value}")
        for stage, values in run.overrides.items()
        for name, value in values.items()
    ]
