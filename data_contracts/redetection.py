"""Result of stage `redetection`: detections, with people found by a second search (R2)."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout, array_layout
from data_contracts.keypoints import (
    EXTRA_ARRAYS,
    FRAME,
    KEYPOINT_ARRAYS,
    KEYPOINT_LABELS,
    OPTIONAL_POINTS,
    POINT_ATTRIBUTE,
)

REDETECTION = GroupLayout(
    stage="redetection",
    about="The detections of `detection`, unchanged, followed by people found where the previous "
    "iteration predicts them.",
    coordinates=(FRAME,),
    arrays=(
        *KEYPOINT_ARRAYS,
        *EXTRA_ARRAYS,
        array_layout(
            "found_again",
            "(*frame, detection) int32 [1], missing -1",
            "person id of the previous iteration for a redetected person; missing for the "
            "detections of `detection`",
        ),
        array_layout(
            "shift",
            "(*frame, detection, joint, axis) float32 [px], missing 0",
            "systematic error of the keypoints of redetected people, as in `filtering`",
        ),
    ),
    labels=KEYPOINT_LABELS,
    attributes={"camera_id": "camera of the match", **POINT_ATTRIBUTE},
    optional=OPTIONAL_POINTS,
)


def redetection_name(detections: str) -> str:
    """Return the name of the redetection result of a detection result; empty for given poses."""
    stage, _, unit = detections.partition("/")
    return f"redetection/{unit}" if stage == "detection" else ""
