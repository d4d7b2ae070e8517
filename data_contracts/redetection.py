"""Result of stage `redetection`: those detected, and who was looked for again and found (R2)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.keypoints import FRAME, KEYPOINT_ARRAYS, KEYPOINT_LABELS

REDETECTION = GroupLayout(
    stage="redetection",
    about="The people of `detection` in their places, and after them those who were found where "
    "the iteration before says that they must be.",
    coordinates=(FRAME,),
    arrays=(
        *KEYPOINT_ARRAYS,
        ArrayLayout(
            name="found_again",
            dims=("frame", "detection"),
            dtype="int32",
            unit="1",
            missing="-1",
            about="who was looked for and found: person id of the iteration before; missing of "
            "those whom `detection` has",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="shift",
            dims=("frame", "detection", "joint", "axis"),
            dtype="float32",
            unit="px",
            missing="0",
            about="by how far keypoints of those found again are beside their joints for lasting "
            "reasons, as `filtering` has it of the others",
            chunk_dim="frame",
        ),
    ),
    labels=KEYPOINT_LABELS,
    attributes={"camera_id": "camera of the match"},
)


def redetection_name(detections: str) -> str:
    """The name of the result with those found again, by that of whom a camera saw.

    Of given ones there is none.
    """
    stage, _, unit = detections.partition("/")
    return f"redetection/{unit}" if stage == "detection" else ""
