"""Result of stage `detection`: the people that nets find in one camera's images (D1-D5)."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout
from data_contracts.keypoints import (
    EXTRA_ARRAYS,
    FRAME,
    KEYPOINT_ARRAYS,
    KEYPOINT_LABELS,
    OPTIONAL_POINTS,
    POINT_ATTRIBUTE,
)

DETECTION = GroupLayout(
    stage="detection",
    about="2D poses detected in one camera's video, by match frame, in the layout of `ingest`.",
    coordinates=(FRAME,),
    arrays=(*KEYPOINT_ARRAYS, *EXTRA_ARRAYS),
    labels=KEYPOINT_LABELS,
    attributes={
        "camera_id": "camera of the match, or clip of its broadcast camera",
        "unreadable": "[first, last] match frame of each interval without an image",
        **POINT_ATTRIBUTE,
    },
    optional=OPTIONAL_POINTS,
)


def detection_unit(camera_id: str, clip_id: str) -> str:
    """Return the name of the unit that detects people in one clip of a static camera."""
    return f"{camera_id}.{clip_id}"
