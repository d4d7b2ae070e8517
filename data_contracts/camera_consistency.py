"""Result of stage `camera_consistency`: which cameras contradict the others, and why."""

from __future__ import annotations

from typing import Literal

from data_contracts.arrays import GroupLayout, array_layout
from data_contracts.records import Name, Number, Record, Share

FaultKind = Literal[
    "flipped",
    "mirrored",
    "focal",
    "lens",
    "clock",
    "frame_rate",
    "swapped",
    "duplicate",
    "pose",
    "contradiction",
]
"""Kind of fault: a pose turned by 180 degrees about the world's z axis, a pose or image mirrored,
the focal length, the distortion, the clock, the frame rate, another camera's video, the same video
as another camera's, a pose in other units or conventions, or two cameras that contradict each
other."""


class CameraFault(Record):
    """A camera that contradicts the others."""

    camera: Name
    kind: FaultKind
    reason: str
    """The fault and its remedy, as a sentence about this camera."""
    value: Number | None = None
    """Stated over true focal length, frames to add to its offset, or true over stated frame rate;
    None for the other kinds."""
    other: Name | None = None
    """The other camera of a swap, duplicate or contradiction."""
    share_now: Share
    """Share of its detections that agree with other cameras as stated [1]."""
    share_corrected: Share | None
    """The same with the fault corrected; None if no correction is known."""


CAMERA_CONSISTENCY = GroupLayout(
    stage="camera_consistency",
    about="Agreement of the static cameras on the people of the clip.",
    arrays=(
        array_layout(
            "agreement",
            "(camera, camera_) float32 [1]",
            "detections of two cameras that match, above chance, per frame",
        ),
    ),
    attributes={
        "camera": "camera ids in the order of the camera dimensions",
        "faults": "a `camera_fault` record for each camera that contradicts the others",
        "left_out": "ids of cameras that later stages leave out",
        "confirmed": "ids of cameras that others agree with",
        "unconfirmed": "ids of cameras that share no person with others",
    },
)
