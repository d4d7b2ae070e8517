"""Result of stage `evaluation`: metrics against truth; an absent metric could not be computed."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, JsonValue

from data_contracts.records import Amount, Count, Frame, Record, Share


def _figure(title: str, description: str, **limits: Any) -> Any:  # noqa: ANN401
    """Return a metric that may be absent: its title in reports, and what it says, with its unit."""
    return Field(default=None, title=title, description=description, **limits)


class CameraErrors(Record):
    """Errors of a group of cameras, over all their frames and points."""

    ground_error_median_m: Amount | None = _figure(
        "ground error",
        "distance on the pitch between a point and the ground position of its pixel, median [m]",
    )
    ground_error_p95_m: Amount | None = _figure(
        "ground error, 95 %", "the same, 95th percentile [m]"
    )
    reprojection_error_median_px: Amount | None = _figure(
        "reprojection error",
        "distance in the image, for points at player height above the pitch, median [px]",
    )
    reprojection_error_p95_px: Amount | None = _figure(
        "reprojection error, 95 %", "the same, 95th percentile [px]"
    )
    center_error_m: Amount | None = _figure("centre", "distance from the true position, mean [m]")
    rotation_error_deg: Amount | None = _figure(
        "rotation", "angle to the true orientation, mean [deg]"
    )
    focal_error_percent: Amount | None = _figure(
        "focal length", "difference to the true focal length, mean [%]"
    )
    coverage: Share | None = _figure("frames", "share of the frames that have an estimate [0..1]")
    cameras: Count | None = _figure("number", "cameras compared")


class CameraEvaluation(Record):
    """Errors of cameras by kind."""

    static: CameraErrors | None = None
    broadcast: CameraErrors | None = None


class Evaluation(Record):
    """Scores of a prediction against a reference (definitions: docs/reference/metrics.md)."""

    mpjpe_mm: Amount | None = _figure(
        "Mean joint error",
        "mean distance between estimated and true joints in world coordinates, without "
        "alignment [mm]",
    )
    g_mpjpe_mm: Amount | None = _figure(
        "G-MPJPE",
        "joint error after one translation, rotation and scaling of all people's trajectories [mm]",
    )
    g_mpjpe_rigid_mm: Amount | None = _figure(
        "G-MPJPE, no scaling", "the same without scaling [mm]"
    )
    per_person_g_mpjpe_mm: Amount | None = _figure(
        "G-MPJPE per person",
        "joint error after a translation, rotation and scaling of each person's trajectory [mm]",
    )
    per_person_g_mpjpe_rigid_mm: Amount | None = _figure(
        "per person, no scaling", "the same without scaling [mm]"
    )
    pa_mpjpe_mm: Amount | None = _figure(
        "PA-MPJPE",
        "joint error after a translation, rotation and scaling of each person in each frame [mm]",
    )
    pa_mpjpe_rigid_mm: Amount | None = _figure(
        "PA-MPJPE, no scaling", "the same without scaling [mm]"
    )
    per_meter_drift_cm_per_m: Amount | None = _figure(
        "Drift", "error of G-MPJPE per metre of a person's true path, mean over people [cm/m]"
    )
    per_meter_drift_rigid_cm_per_m: Amount | None = _figure(
        "Drift, no scaling", "the same without scaling [cm/m]"
    )
    per_person_drift_cm_per_m: Amount | None = _figure(
        "Drift per person",
        "error of G-MPJPE per person, per metre of the person's true path [cm/m]",
    )
    per_person_drift_rigid_cm_per_m: Amount | None = _figure(
        "Drift per person, no scaling", "the same without scaling [cm/m]"
    )
    g_scale: Amount | None = _figure(
        "Scaling", "factor by which G-MPJPE scales the prediction; 1 is the true size"
    )
    challenge_score: Amount | None = _figure(
        "Challenge score",
        "global joint error plus five times the joint error relative to the hips; without big "
        "toes [m]",
    )
    challenge_global_m: Amount | None = _figure(
        "global part of it", "joint error of tracks in world coordinates [m]"
    )
    challenge_local_m: Amount | None = _figure(
        "local part of it", "joint error relative to the hips [m]"
    )
    acceleration_error_m_s2: Amount | None = _figure(
        "Acceleration error",
        "difference to the true acceleration of joints: jitter or too much smoothing [m/s²]",
    )
    track_coverage: Share | None = _figure(
        "People followed",
        "share of true people in all frames that the metrics of tracks include [0..1]",
    )
    pcp3d: float | None = _figure(
        "Correct limbs",
        "limbs whose ends have a mean error of at most half the limb's length; missing ones "
        "are wrong [%]",
        ge=0,
        le=100,
    )
    coverage: Share | None = _figure(
        "People found",
        "recall: share of true people in all frames with a matched prediction [0..1]",
    )
    joint_coverage: Share | None = _figure(
        "Joints found", "share of true joints with an estimated joint [0..1]"
    )
    false_persons_per_frame: Amount | None = _figure(
        "False positives", "mean number of predicted people without a true person [per frame]"
    )
    idf1: Share | None = _figure(
        "IDF1", "share of true and predicted people in all frames that have the right id [0..1]"
    )
    hota: Share | None = _figure(
        "HOTA", "geometric mean of detection and association accuracy [0..1]"
    )
    detection_accuracy: Share | None = _figure(
        "detection part of it", "true positives among all true and predicted people [0..1]"
    )
    association_accuracy: Share | None = _figure(
        "association part of it", "how pure and complete the tracks are [0..1]"
    )
    switches: Count | None = _figure(
        "Switches", "times that a true person continues under another id"
    )
    switches_per_minute: Amount | None = _figure(
        "Switches", "of the match, all people together [per minute]"
    )
    fragmentations: Count | None = _figure(
        "Fragmentations", "times that a track of a true person is interrupted"
    )
    persons: Count | None = _figure("True people", "people with enough visible joints to count")
    frames: Count | None = _figure("Frames scored", "all frames of the reference")
    cameras: CameraEvaluation | None = None
    """Errors of cameras."""


class MethodScore(Record):
    """Scores of a baseline method against the truth, with the settings of the evaluation."""

    method: str
    """Name of the method."""
    title: str
    """Title in tables."""
    source: str
    """File or folder of its result."""
    world: Literal["shared", "own", "camera"]
    """Frame of its people: one world, one world per person, or the camera. Scores without a meaning
    in that frame are absent."""
    body_model: str
    """Body model that its poses are applied to."""
    notes: dict[str, str]
    """Conversions beyond reading the files."""
    match_in: str | None
    """Camera in whose image tracks were matched; None = by distance in the world."""
    first_frame: Frame
    """Match frame of the method's first image."""
    settings: dict[str, JsonValue]
    """Settings of the evaluation."""
    evaluation: Evaluation
    clips: dict[str, Evaluation] = {}
    """Scores by clip of a data set; `evaluation` then has those of all clips together."""
