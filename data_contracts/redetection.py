"""Result of stage `redetection`: detections, with people found by a second search (R2)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout
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
        ArrayLayout(
            name="found_again",
            dims=("frame", "detection"),
            dtype="int32",
            unit="1",
            missing="-1",
            about="person id of the previous iteration for a redetected person; missing for the "
            "detections of `detection`",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="shift",
            dims=("frame", "detection", "joint", "axis"),
            dtype="float32",
            unit="px",
            missing="0",
            about="systematic error of the keypoints of redetected people, as in `filtering`",
            chunk_dim="frame",
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
