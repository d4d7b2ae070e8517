"""Clicks in a clip's key frames, and results of `broadcast_calibration` and `broadcast_pooling`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.arrays import GroupLayout, array_layout, array_layouts
from data_contracts.cameras import CAMERA_LABELS
from data_contracts.keypoints import FRAME
from data_contracts.records import CONTRACT_VERSION, FRAME_LIMIT, Record
from data_contracts.static_calibration import ClickedMarkings


class KeyFrame(Record):
    """Clicks in one frame of a broadcast clip."""

    frame: int = Field(ge=0, le=FRAME_LIMIT)
    """Number in the video, from 0."""
    markings: ClickedMarkings
    """Points and drawn markings in its image."""


class KeyFrames(Record):
    """annotations/broadcast_calibration/<view>.json: the clicks of one broadcast view."""

    contract: Literal[1] = CONTRACT_VERSION
    key_frames: tuple[KeyFrame, ...] = Field(min_length=1)
    """Key frames in rising order, each frame once."""


FRAME_STEP = ("rx", "ry", "rz", "log_focal", "k1", "k2", "k3")
"""A small change of one frame's camera: rotation about its center in its own axes [rad], the
logarithm of the focal length, radial distortion [1]."""

CLIP_STEP = ("x", "y", "z", "cx", "cy")
"""A small change of what all frames share: center, world [m], and principal point [px]."""

FRAME_STATUS = ("missing", "bridged", "followed", "players", "lines", "key_frame")
"""Best evidence for a frame's camera: none (there is no camera), neighbouring frames alone, motion
of the background, players, painted lines detected in the image, or clicks."""


_BEFORE = "the same before the joint fit with players: each frame from its painted lines alone"

BROADCAST_CALIBRATION = GroupLayout(
    stage="broadcast_calibration",
    about="The broadcast camera in every frame of a clip, with covariance and evidence.",
    coordinates=(FRAME,),
    arrays=(
        *array_layouts(
            """
            focal (*frame, axis) float64 [px], missing nan:
                focal lengths fx, fy
            principal_point (*frame, axis) float64 [px], missing nan:
                principal point, one for the clip
            distortion (*frame, coefficient) float64 [1], missing nan:
                k1, k2, p1, p2, k3 of Brown's model in OpenCV's order; k4, k5 and k6 are 0
            rotation (*frame, cam_coordinate, coordinate) float64 [1], missing nan:
                R in x_cam = R x_world + t
            translation (*frame, cam_coordinate) float64 [m], missing nan:
                t in x_cam = R x_world + t
            image_size (axis) int64 [px]:
                width, height
            center (coordinate) float64 [m]:
                the camera's center, world, one for the clip
            covariance (*frame, parameter, parameter_) float64 [1], missing nan:
                covariance of a step of the frame's camera, in the units of its parameters; zero for
                parameters that were not solved for
            shared_covariance (*frame, parameter, clip_parameter) float64 [1], missing nan:
                covariance of a step of the frame's camera with what all frames share
            clip_covariance (clip_parameter, clip_parameter_) float64 [1]:
                covariance of what all frames share
            """
        ),
        array_layout("focal_before", "(*frame, axis) float64 [px], missing nan", _BEFORE),
        array_layout("principal_point_before", "(*frame, axis) float64 [px], missing nan", _BEFORE),
        array_layout(
            "distortion_before", "(*frame, coefficient) float64 [1], missing nan", _BEFORE
        ),
        array_layout(
            "rotation_before",
            "(*frame, cam_coordinate, coordinate) float64 [1], missing nan",
            _BEFORE,
        ),
        array_layout(
            "translation_before", "(*frame, cam_coordinate) float64 [m], missing nan", _BEFORE
        ),
        *array_layouts(
            """
            status (frame) uint8 [1], missing 0:
                evidence for the frame's camera, an index into the attribute `status_names`
            reprojection_error (*frame) float64 [px], missing nan:
                expected image error of a player's position, root mean square over the visible pitch
            marking_rms (*frame) float64 [px], missing nan:
                rms distance of detected painted lines, across them
            player_rms (*frame) float64 [px], missing nan:
                rms residual of the keypoints of matched players
            marking_count (frame) int32 [1], missing 0:
                samples of painted lines used in the frame
            player_count (frame) int32 [1], missing 0:
                players matched with people from the static cameras
            flow_count (frame) int32 [1], missing 0:
                points tracked from this frame to the next
            """
        ),
    ),
    labels={
        **CAMERA_LABELS,
        "parameter": FRAME_STEP,
        "parameter_": FRAME_STEP,
        "clip_parameter": CLIP_STEP,
        "clip_parameter_": CLIP_STEP,
    },
    attributes={
        "clip_id": "clip of the match",
        "status_names": "meanings of `status`",
        "key_frames": "clicked frames that were used, by their number in the clip's video, from 0",
        "refused_key_frames": "clicked frames that could not be used, with the reason",
        "weights": "weights and noise of the loss terms, with the rule of each",
        "feed_offset": "frame t of the clip shows the moment t + `frames` of the static cameras, "
        "with standard error [match frame] and number of pairs; `frames` is null if undetermined, "
        "the whole entry is null without people",
        "drift": "error of tracking from one key frame at the next one [px], by gap",
        "pick_next": "frames whose clicks would reduce the error most, the best first",
        "markings_off": "median distance of painted lines from their projection [px], before and "
        "after the joint fit with players",
        "players_off": "the same for people, by the mean over a person's keypoints",
        "pitch": "the pitch that the fit shows: `length`, `width`, `crown`, `end_fall` and "
        "`points` as in pitch.json, and `std_m` of the first four, 0 where they are given; null if "
        "all is given",
        "noise": "`paint_m`, the spread of markings without survey about the rules, and the "
        "deviations of samples of `lines` and of `clicks` over their assumed ones",
        "decisions": "choices made, with the metrics that decided",
        "reasons": "reasons for a manual review; empty if none is needed",
    },
)

_CAMERA = (
    *("focal", "principal_point", "distortion", "rotation", "translation", "image_size"),
    *("center", "covariance", "shared_covariance", "clip_covariance"),
)

BROADCAST_POOLING = GroupLayout(
    stage="broadcast_pooling",
    about="The broadcast camera of a clip, with the center that all clips of the match share.",
    coordinates=BROADCAST_CALIBRATION.coordinates,
    arrays=tuple(BROADCAST_CALIBRATION.layout(name) for name in _CAMERA),
    labels=BROADCAST_CALIBRATION.labels,
    attributes={
        "clip_id": "clip of the match",
        "clips": "clips of the same camera, including this one",
        "distance": "distance of each clip's own center from the common one [standard deviations]",
        "agree": "whether one center explains all clips; otherwise the camera is unchanged",
    },
)
