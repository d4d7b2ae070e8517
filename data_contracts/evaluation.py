"""Result of stage `evaluation`: metrics against truth; an absent metric could not be computed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from data_contracts.records import Amount, Count, Frame, Record, Share


class CameraErrors(Record):
    """Errors of a group of cameras, over all their frames and points."""

    ground_error_median_m: Amount | None = None
    """On the pitch surface, between a true point and the back-projection of its true pixel [m]."""
    ground_error_p95_m: Amount | None = None
    """The same; 95 % of the points are better [m]."""
    reprojection_error_median_px: Amount | None = None
    """Median error in the image, over the pitch at player height [px]."""
    reprojection_error_p95_px: Amount | None = None
    """The same; 95 % of the points are better [px]."""
    center_error_m: Amount | None = None
    """Distance of the camera centres, mean [m]."""
    rotation_error_deg: Amount | None = None
    """Angle between the orientations, mean [deg]."""
    focal_error_percent: Amount | None = None
    """Difference of the focal lengths, mean [%]."""
    coverage: Share | None = None
    """Share of the frames that have an estimate [0..1]."""
    cameras: Count | None = None
    """Cameras compared."""


class CameraEvaluation(Record):
    """Errors of cameras by kind."""

    static: CameraErrors | None = None
    broadcast: CameraErrors | None = None


class Evaluation(Record):
    """Scores of a prediction against a reference (definitions: docs/reference/metrics.md)."""

    mpjpe_mm: Amount | None = None
    """Mean distance of matched joints without any alignment [mm]."""
    g_mpjpe_mm: Amount | None = None
    """Mean joint distance after one similarity for all people's whole trajectories [mm]."""
    g_mpjpe_rigid_mm: Amount | None = None
    """The same, without scale [mm]."""
    per_person_g_mpjpe_mm: Amount | None = None
    """Mean joint distance after one similarity for each person's whole trajectory [mm]."""
    per_person_g_mpjpe_rigid_mm: Amount | None = None
    """The same, without scale [mm]."""
    pa_mpjpe_mm: Amount | None = None
    """Mean joint distance after one similarity for each person in each frame [mm]."""
    pa_mpjpe_rigid_mm: Amount | None = None
    """The same, without scale [mm]."""
    per_meter_drift_cm_per_m: Amount | None = None
    """Error behind g_mpjpe_mm over the length of the true path, mean over people [cm/m]."""
    per_meter_drift_rigid_cm_per_m: Amount | None = None
    """The same, of g_mpjpe_rigid_mm [cm/m]."""
    per_person_drift_cm_per_m: Amount | None = None
    """The same, of per_person_g_mpjpe_mm [cm/m]."""
    per_person_drift_rigid_cm_per_m: Amount | None = None
    """The same, of per_person_g_mpjpe_rigid_mm [cm/m]."""
    g_scale: Amount | None = None
    """Factor by which the alignment of g_mpjpe_mm enlarges the prediction [1]."""
    challenge_score: Amount | None = None
    """Global plus five times local joint error, without alignment and big toes [m]."""
    challenge_global_m: Amount | None = None
    """Its first part: mean joint distance in the world [m]."""
    challenge_local_m: Amount | None = None
    """Its second part before the factor: mean joint distance relative to the mid-hip [m]."""
    acceleration_error_m_s2: Amount | None = None
    """Mean error of joint acceleration [m/s^2]."""
    track_coverage: Share | None = None
    """Share of true person-frames in the scores of whole tracks [0..1]."""
    pcp3d: float | None = Field(default=None, ge=0, le=100)
    """Share of correct limbs at alpha 0.5, missing limbs counted wrong [%]."""
    coverage: Share | None = None
    """Share of true person-frames that have a matched prediction [0..1]."""
    joint_coverage: Share | None = None
    """Share of true joints that have a predicted joint [0..1]."""
    false_persons_per_frame: Amount | None = None
    """Mean number of predicted people per frame that match no true person."""
    idf1: Share | None = None
    """Share of person-frames on either side that carry the right id [0..1]."""
    hota: Share | None = None
    """HOTA: geometric mean of detection and association accuracy over 19 distances [0..1]."""
    detection_accuracy: Share | None = None
    """Detection part of HOTA [0..1]."""
    association_accuracy: Share | None = None
    """Association part of HOTA [0..1]."""
    switches: Count | None = None
    """Number of changes of a true person from one predicted id to another."""
    switches_per_minute: Amount | None = None
    """The same per minute of the match, all people together [1/min]."""
    fragmentations: Count | None = None
    """Number of times that the track of a true person is interrupted."""
    persons: Count | None = None
    """True people."""
    frames: Count | None = None
    """Frames scored."""
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
