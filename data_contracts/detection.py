"""Result of stage `detection`: the people that nets found in one camera's pictures (D1-D3)."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout
from data_contracts.keypoints import FRAME, KEYPOINT_ARRAYS, KEYPOINT_LABELS

DETECTION = GroupLayout(
    stage="detection",
    about="2D poses found in one camera's video, on the match's clock: as `ingest` has given ones.",
    coordinates=(FRAME,),
    arrays=KEYPOINT_ARRAYS,
    labels=KEYPOINT_LABELS,
    attributes={
        "camera_id": "camera of the match, or clip of its broadcast camera",
        "unreadable": "[first, last] match frames of each stretch without a picture",
    },
)


def detection_unit(camera_id: str, clip_id: str) -> str:
    """The unit of a static camera's people in a clip."""
    return f"{camera_id}.{clip_id}"
