"""Labels, units and descriptions of the evaluation metrics."""

from __future__ import annotations

from typing import Final

from data_contracts.evaluation import Evaluation

MEANINGS: Final = {
    "mpjpe_mm": (
        "Mean joint error",
        "mm",
        "how far a found joint is from the true one on average, in world coordinates as they are",
    ),
    "g_mpjpe_mm": (
        "G-MPJPE",
        "mm",
        "the same after one shift, turn and scaling of all people's whole trajectories",
    ),
    "g_mpjpe_rigid_mm": ("G-MPJPE, size kept", "mm", "the same without scaling"),
    "per_person_g_mpjpe_mm": (
        "G-MPJPE per person",
        "mm",
        "the same after a shift, turn and scaling of each person's whole trajectory",
    ),
    "per_person_g_mpjpe_rigid_mm": ("per person, size kept", "mm", "the same without scaling"),
    "pa_mpjpe_mm": (
        "PA-MPJPE",
        "mm",
        "joint error after a shift, turn and scaling of each person in each frame: the pose alone",
    ),
    "pa_mpjpe_rigid_mm": ("PA-MPJPE, size kept", "mm", "the same without scaling"),
    "per_meter_drift_cm_per_m": (
        "Drift",
        "cm/m",
        "error behind G-MPJPE for each metre that a person truly went, mean over people",
    ),
    "per_meter_drift_rigid_cm_per_m": ("Drift, size kept", "cm/m", "the same without scaling"),
    "per_person_drift_cm_per_m": (
        "Drift per person",
        "cm/m",
        "error behind G-MPJPE per person for each metre that a person truly went",
    ),
    "per_person_drift_rigid_cm_per_m": (
        "Drift per person, size kept",
        "cm/m",
        "the same without scaling",
    ),
    "g_scale": ("Scaling", "", "by which G-MPJPE enlarges the prediction; 1 is the true size"),
    "challenge_score": (
        "Challenge score",
        "m",
        "joint error in the world plus five times that relative to the hips; without big toes",
    ),
    "challenge_global_m": ("its part in the world", "m", "joint error of whole tracks"),
    "challenge_local_m": ("its part by the hips", "m", "joint error after the hips are laid over"),
    "acceleration_error_m_s2": (
        "Acceleration error",
        "m/s²",
        "how much joints jitter, or are smoothed, against the truth",
    ),
    "track_coverage": (
        "People followed",
        "%",
        "share of the true people of all frames that scores of whole tracks are taken on",
    ),
    "pcp3d": (
        "Correct limbs",
        "%",
        "limbs whose ends are off by at most half the limb's length; missing ones count as wrong",
    ),
    "coverage": ("People found", "%", "share of the true people of all frames that were found"),
    "joint_coverage": ("Joints found", "%", "share of the true joints that have a found one"),
    "false_persons_per_frame": (
        "False people",
        "per frame",
        "people reported where nobody is, on average",
    ),
    "idf1": ("IDF1", "%", "share of people in all frames, true and found, who have the right id"),
    "hota": ("HOTA", "%", "finding people and keeping them apart, both at once"),
    "detection_accuracy": ("its part of finding", "%", "people found, without false ones"),
    "association_accuracy": ("its part of keeping apart", "%", "how pure and whole tracks are"),
    "switches": ("Switches", "", "times a true person goes on under another id"),
    "switches_per_minute": ("Switches", "per minute", "of the match, all people together"),
    "fragmentations": ("Fragmentations", "", "times a true person is lost and found again"),
    "persons": ("True people", "", "who can be seen well enough to be scored"),
    "frames": ("Frames scored", "", "all frames of the reference"),
    "cameras": ("Cameras", "", "errors of the estimated cameras by kind"),
}
"""Label, unit and description of every metric; shares are shown in per cent."""

CAMERA_MEANINGS: Final = {
    "ground_error_median_m": (
        "ground error",
        "m",
        "how far from a point of the pitch its pixel is put on the pitch, median",
    ),
    "ground_error_p95_m": ("ground error, 95 %", "m", "the same; 95 % of the points are better"),
    "reprojection_error_median_px": (
        "reprojection error",
        "px",
        "in the picture, for points at player height over the pitch, median",
    ),
    "reprojection_error_p95_px": (
        "reprojection error, 95 %",
        "px",
        "the same; 95 % of the points are better",
    ),
    "center_error_m": ("centre", "m", "distance from the true place, mean"),
    "rotation_error_deg": ("rotation", "deg", "angle to the true orientation, mean"),
    "focal_error_percent": ("focal length", "%", "difference to the true one, mean"),
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
                (
                    f"cameras.{kind}.{name}",
                    f"{kind.capitalize()} cameras: {label}",
                    shown,
                    meaning,
                )
            )
    return rows


def _score_row(meaning: tuple[str, str, str], name: str, value: float) -> tuple[str, str, str]:
    label, unit, words = meaning
    shown = shown_number(100.0 * value if name in SHARES else value)
    return label, f"{shown} {unit}".strip(), words


def shown_number(value: float) -> str:
    """Return a number with four digits, without exponent if possible."""
    return f"{value:,.0f}" if float(value).is_integer() or abs(value) >= 1e4 else f"{value:.4g}"
