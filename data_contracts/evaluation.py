"""Result of stage `evaluation`: figures against truth; an absent figure could not be computed."""

from __future__ import annotations

from typing import Literal

from pydantic import JsonValue

from data_contracts.records import Record


class CameraErrors(Record):
    """Errors of a group of cameras, over all their frames and points."""

    ground_error_median_m: float | None = None
    """On the pitch surface, between a true point and the back-projection of its true pixel [m]."""
    ground_error_p95_m: float | None = None
    """The same; 95 % of the points are better [m]."""
    reprojection_error_median_px: float | None = None
    """In the picture, over the pitch at player height [px]."""
    reprojection_error_p95_px: float | None = None
    """The same; 95 % of the points are better [px]."""
    center_error_m: float | None = None
    """Distance of the camera centres, mean [m]."""
    rotation_error_deg: float | None = None
    """Angle between the orientations, mean [deg]."""
    focal_error_percent: float | None = None
    """Difference of the focal lengths, mean [%]."""
    coverage: float | None = None
    """Share of the frames that have an estimate [0..1]."""
    cameras: int | None = None
    """Cameras compared."""


class CameraEvaluation(Record):
    """Errors of cameras by kind."""

    static: CameraErrors | None = None
    broadcast: CameraErrors | None = None


class Evaluation(Record):
    """Scores of a prediction against a reference (definitions: docs/metrics.md)."""

    mpjpe_mm: float | None = None
    """Mean distance of matched joints without any alignment [mm]."""
    g_mpjpe_mm: float | None = None
    """Mean joint distance after one similarity for all people's whole trajectories [mm]."""
    g_mpjpe_rigid_mm: float | None = None
    """The same, without scale [mm]."""
    per_person_g_mpjpe_mm: float | None = None
    """Mean joint distance after one similarity for each person's whole trajectory [mm]."""
    per_person_g_mpjpe_rigid_mm: float | None = None
    """The same, without scale [mm]."""
    pa_mpjpe_mm: float | None = None
    """Mean joint distance after one similarity for each person in each frame [mm]."""
    pa_mpjpe_rigid_mm: float | None = None
    """The same, without scale [mm]."""
    per_meter_drift_cm_per_m: float | None = None
    """Error behind g_mpjpe_mm over the length of the true path, mean over people [cm/m]."""
    per_meter_drift_rigid_cm_per_m: float | None = None
    """The same, of g_mpjpe_rigid_mm [cm/m]."""
    per_person_drift_cm_per_m: float | None = None
    """The same, of per_person_g_mpjpe_mm [cm/m]."""
    per_person_drift_rigid_cm_per_m: float | None = None
    """The same, of per_person_g_mpjpe_rigid_mm [cm/m]."""
    g_scale: float | None = None
    """Factor by which the alignment of g_mpjpe_mm enlarges the prediction [1]."""
    challenge_score: float | None = None
    """Global plus five times local joint error, without alignment and big toes [m]."""
    challenge_global_m: float | None = None
    """Its first part: mean joint distance in the world [m]."""
    challenge_local_m: float | None = None
    """Its second part before the factor: mean joint distance relative to the mid-hip [m]."""
    acceleration_error_m_s2: float | None = None
    """Mean error of joint acceleration [m/s^2]."""
    track_coverage: float | None = None
    """Share of true person-frames that the scores of whole tracks are taken on [0..1]."""
    pcp3d: float | None = None
    """Share of correct limbs at alpha 0.5, missing limbs counted wrong [%]."""
    coverage: float | None = None
    """Share of true person-frames that have a matched prediction [0..1]."""
    joint_coverage: float | None = None
    """Share of true joints that have a predicted joint [0..1]."""
    false_persons_per_frame: float | None = None
    """Predicted people in a frame that match no true one, mean."""
    idf1: float | None = None
    """Share of person-frames on either side that carry the right id [0..1]."""
    hota: float | None = None
    """Geometric mean of finding people and keeping them apart, over 19 distances [0..1]."""
    detection_accuracy: float | None = None
    """The part of HOTA that is finding people [0..1]."""
    association_accuracy: float | None = None
    """The part of HOTA that is keeping them apart [0..1]."""
    switches: int | None = None
    """Times that a true person changes from one predicted id to another."""
    switches_per_minute: float | None = None
    """The same in a minute of the match, all people together [1/min]."""
    fragmentations: int | None = None
    """Times that a true person is lost and found again."""
    persons: int | None = None
    """True people."""
    frames: int | None = None
    """Frames scored."""
    cameras: CameraEvaluation | None = None
    """Errors of cameras."""


class MethodScore(Record):
    """How well another method's result agrees with the truth, and under which settings."""

    method: str
    """Name of the method."""
    title: str
    """What tables call it."""
    source: str
    """File or folder of its result."""
    world: Literal["shared", "own", "camera"]
    """Where it puts people: in one world, each in one of his own, or relative to the camera. What
    then means nothing is absent from the scores."""
    body_model: str
    """Body that its poses were put on."""
    notes: dict[str, str]
    """What was done beyond reading."""
    match_in: str | None
    """Camera in whose picture tracks were matched; None = by distance in the world."""
    first_frame: int
    """Match frame of the method's first picture."""
    settings: dict[str, JsonValue]
    """Settings of the evaluation."""
    evaluation: Evaluation
