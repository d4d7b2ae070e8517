"""Results of stages `tracking` and `broadcast_tracking`: who is who over time."""

from __future__ import annotations

from typing import Literal

from data_contracts.arrays import GroupLayout, array_layout, array_layouts
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME
from data_contracts.records import Amount, Count, Frame, Label, Number, PersonId, Record

PERSON = array_layout("person", "(person) int32 [1]", "person id, stable within the clip, from 0")

TRACKING = GroupLayout(
    stage="tracking",
    about="The person of every camera's detections.",
    coordinates=(FRAME, PERSON),
    arrays=array_layouts(
        """
        detection_index (*frame, camera, person) int16 [1], missing -1:
            index among this camera's detections of the frame, in `ingest`, `detection` or, from the
            second iteration on, `redetection`
        ray_distance (*frame, camera, person) float32 [m], missing nan:
            mean distance of the detection's rays to the person's joints when matched
        joints (*frame, person, joint, coordinate) float32 [m], missing nan:
            the tracker's fast 3D joints, world; those of `triangulation` are accurate
        ground (*frame, person, axis) float32 [m], missing nan:
            place on the pitch from the feet, smoothed; finite exactly in the frames in which the
            person is not triangulated but placed by the feet (kind `plane`)
        ground_velocity (*frame, person, axis) float32 [m/s], missing nan:
            derivative of `ground`
        ground_covariance (*frame, person, axis, axis_) float32 [m^2], missing nan:
            covariance of `ground`: noise of the feet, and calibration
        ground_height (person) float32 [m], missing nan:
            height of people who are placed by their feet, by their boxes
        """
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
        "changes": "cameras whose people the tracker had lost, each a CameraChange",
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
    name: Label | None = None
    """Roster id or name; readers take it from the journal, and no result contains it."""
    kind: Literal["triangulated", "mixed", "plane"] = "triangulated"
    """Whether views triangulate the person in all frames, in some, or in none, where the feet alone
    give a place on the pitch."""
    plane_frames: Count = 0
    """Frames in which the feet alone place the person."""


class Join(Record):
    """Two tracks that are, or may be, one person; or a track that may pass to another person."""

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


_GROUND = ("ground", "ground_velocity", "ground_covariance", "ground_height")

BROADCAST_TRACKING = TRACKING.model_copy(
    update={
        "stage": "broadcast_tracking",
        "about": "The people of a broadcast clip on the pitch, where no static camera films them.",
        "arrays": (
            array_layout(
                "detection_index",
                "(*frame, person) int16 [1], missing -1",
                "index among the clip's detections of the frame, in `ingest` or `detection`",
            ),
            *(TRACKING.layout(name) for name in _GROUND),
        ),
        "labels": {"axis": ("x", "y"), "axis_": ("x", "y")},
        "optional": ("given_people",),
        "attributes": {
            "clip_id": "clip of the match",
            "tracks": "one `track` record per person",
            "given_people": "number of people of given boxes with identities; `person` is their "
            "row",
        },
    }
)
