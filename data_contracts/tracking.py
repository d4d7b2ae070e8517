"""Result of stage `tracking`: identities across cameras and over time (T1, T2)."""

from __future__ import annotations

from typing import Literal

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME
from data_contracts.records import Amount, Count, Frame, Name, Number, PersonId, Record

PERSON = ArrayLayout(
    name="person",
    dims=("person",),
    dtype="int32",
    unit="1",
    missing="none",
    about="person id, stable within the clip, from 0",
)

TRACKING = GroupLayout(
    stage="tracking",
    about="The person of every camera's detections.",
    coordinates=(FRAME, PERSON),
    arrays=(
        ArrayLayout(
            name="detection_index",
            dims=("frame", "camera", "person"),
            dtype="int16",
            unit="1",
            missing="-1",
            about="index among this camera's detections of the frame, in `ingest`, `detection` or, "
            "from the second iteration on, `redetection`",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="ray_distance",
            dims=("frame", "camera", "person"),
            dtype="float32",
            unit="m",
            missing="nan",
            about="mean distance of the detection's rays to the person's joints when matched",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="joints",
            dims=("frame", "person", "joint", "coordinate"),
            dtype="float32",
            unit="m",
            missing="nan",
            about="the tracker's fast 3D joints, world; those of `triangulation` are accurate",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="ground",
            dims=("frame", "person", "axis"),
            dtype="float32",
            unit="m",
            missing="nan",
            about="place on the pitch from the feet, smoothed; finite exactly in the frames in "
            "which the person is not triangulated but placed by the feet (kind `plane`)",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="ground_velocity",
            dims=("frame", "person", "axis"),
            dtype="float32",
            unit="m/s",
            missing="nan",
            about="derivative of `ground`",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="ground_covariance",
            dims=("frame", "person", "axis", "axis_"),
            dtype="float32",
            unit="m^2",
            missing="nan",
            about="covariance of `ground`: noise of the feet, and calibration",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="ground_height",
            dims=("person",),
            dtype="float32",
            unit="m",
            missing="nan",
            about="height of people who are placed by their feet, by their boxes",
        ),
    ),
    labels={
        "joint": COCO17,
        "coordinate": ("x", "y", "z"),
        "axis": ("x", "y"),
        "axis_": ("x", "y"),
    },
    optional=("ground", "ground_velocity", "ground_covariance", "ground_height"),
    attributes={
        "camera": "camera ids in the order of the camera dimension",
        "tracks": "one `track` record per person",
        "joins": "`join` records: undecided ones first, then by falling cost",
        "objections": "for each correction, in order: why it does not apply; null if it does",
    },
)


class Track(Record):
    """The track of one person within one clip."""

    person: PersonId
    first_frame: Frame
    last_frame: Frame
    frames_seen: Count
    """Frames with at least one matched detection."""
    views: Amount
    """Mean number of cameras in those frames."""
    name: Name | None = None
    """Roster id, where known."""
    kind: Literal["triangulated", "mixed", "plane"] = "triangulated"
    """Whether views triangulate the person in all frames, in some, or in none, where the feet alone
    give a place on the pitch."""
    plane_frames: Count = 0
    """Frames in which the feet alone place the person."""


class Join(Record):
    """Two tracks that are, or may be, one person."""

    before: PersonId
    """Person of the track that stops."""
    after: PersonId
    """Person of the track that begins; the same where it was decided."""
    last_frame: Frame
    """Last frame of the first track, counted from the clip's first."""
    first_frame: Frame
    """First frame of the second."""
    cost: Number
    """Minus the logarithm of the odds that they are one person rather than two [1]."""
    margin: Number | None
    """Logarithm of the odds of this join against every other way [1]; None = beyond doubt."""
    decided: bool
    """Whether they were joined; otherwise a reviewer decides."""
