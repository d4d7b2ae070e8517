"""Clicks in a clip's key frames, and the result of stage `broadcast_calibration`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.arrays import ArrayLayout, GroupLayout
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
    """annotations/broadcast_calibration/<clip>.json: all clicks of one clip (M2)."""

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


def _by_frame(
    name: str, dims: tuple[str, ...], unit: str, about: str, missing: Literal["nan"] = "nan"
) -> ArrayLayout:
    return ArrayLayout(
        name=name,
        dims=("frame", *dims),
        dtype="float64",
        unit=unit,
        missing=missing,
        about=about,
        chunk_dim="frame",
    )


def _count_array(name: str, about: str) -> ArrayLayout:
    return ArrayLayout(
        name=name, dims=("frame",), dtype="int32", unit="1", missing="0", about=about
    )


_BEFORE = "the same before the joint fit with players: each frame from its painted lines alone"

BROADCAST_CALIBRATION = GroupLayout(
    stage="broadcast_calibration",
    about="The broadcast camera in every frame of a clip, with covariance and evidence.",
    coordinates=(FRAME,),
    arrays=(
        _by_frame("focal", ("axis",), "px", "focal lengths fx, fy"),
        _by_frame("principal_point", ("axis",), "px", "principal point, one for the clip"),
        _by_frame("distortion", ("coefficient",), "1", "k1, k2, p1, p2, k3 in OpenCV's order"),
        _by_frame("rotation", ("cam_coordinate", "coordinate"), "1", "R in x_cam = R x_world + t"),
        _by_frame("translation", ("cam_coordinate",), "m", "t in x_cam = R x_world + t"),
        ArrayLayout(
            name="image_size",
            dims=("axis",),
            dtype="int64",
            unit="px",
            missing="none",
            about="width, height",
        ),
        ArrayLayout(
            name="center",
            dims=("coordinate",),
            dtype="float64",
            unit="m",
            missing="none",
            about="the camera's center, world, one for the clip",
        ),
        _by_frame(
            "covariance",
            ("parameter", "parameter_"),
            "1",
            "covariance of a step of the frame's camera, in the units of its parameters; zero for "
            "parameters that were not solved for",
        ),
        _by_frame(
            "shared_covariance",
            ("parameter", "clip_parameter"),
            "1",
            "covariance of a step of the frame's camera with what all frames share",
        ),
        ArrayLayout(
            name="clip_covariance",
            dims=("clip_parameter", "clip_parameter_"),
            dtype="float64",
            unit="1",
            missing="none",
            about="covariance of what all frames share",
        ),
        _by_frame("focal_before", ("axis",), "px", _BEFORE),
        _by_frame("principal_point_before", ("axis",), "px", _BEFORE),
        _by_frame("distortion_before", ("coefficient",), "1", _BEFORE),
        _by_frame("rotation_before", ("cam_coordinate", "coordinate"), "1", _BEFORE),
        _by_frame("translation_before", ("cam_coordinate",), "m", _BEFORE),
        ArrayLayout(
            name="status",
            dims=("frame",),
            dtype="uint8",
            unit="1",
            missing="0",
            about="evidence for the frame's camera, an index into the attribute `status_names`",
        ),
        _by_frame(
            "reprojection_error",
            (),
            "px",
            "expected image error of a player's position, root mean square over the visible pitch",
        ),
        _by_frame(
            "marking_rms",
            (),
            "px",
            "rms distance of detected painted lines, across them",
        ),
        _by_frame("player_rms", (), "px", "rms residual of the keypoints of matched players"),
        _count_array("marking_count", "samples of painted lines used in the frame"),
        _count_array("player_count", "players matched with people from the static cameras"),
        _count_array("flow_count", "points tracked from this frame to the next"),
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
        "with standard error [frame] and number of pairs; `frames` is null if undetermined, the "
        "whole entry is null without people",
        "drift": "error of tracking from one key frame at the next one [px], by gap",
        "pick_next": "frames whose clicks would reduce the error most, the best first",
        "markings_off": "median distance of painted lines from their projection [px], before and "
        "after the joint fit with players",
        "players_off": "the same for people, by the mean over a person's keypoints",
        "pitch": "the pitch that the fit shows: `length`, `width`, `crown`, `end_fall` and "
        "`points` as in pitch.json, and `std_m` of the first four, 0 where they are given; null if "
        "all is given",
        "noise": "`paint_m`, the spread of markings without survey about the Laws, and the "
        "deviations of samples of `lines` and of `clicks` over their assumed ones",
        "decisions": "choices made, with the metrics that decided",
        "reasons": "reasons for a manual review; empty if none is needed",
    },
)
