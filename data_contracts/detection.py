"""Results of `detection` and `redetection`: people that nets find in images."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout, array_layouts
from data_contracts.keypoints import (
    EXTRA_ARRAYS,
    FRAME,
    KEYPOINT_ARRAYS,
    KEYPOINT_LABELS,
    OPTIONAL_POINTS,
    POINT_ATTRIBUTE,
)

IMAGE_ARRAYS = array_layouts(
    """
    brightness (*frame) float32 [1], missing nan:
        mean of the image, of 255
    sharpness (*frame) float32 [1], missing nan:
        mean difference of neighbouring pixels of a row, of 255
    """
)

DETECTION = GroupLayout(
    stage="detection",
    about="2D poses detected in one camera's video, by match frame, in the layout of `ingest`.",
    coordinates=(FRAME,),
    arrays=(*KEYPOINT_ARRAYS, *EXTRA_ARRAYS, *IMAGE_ARRAYS),
    labels=KEYPOINT_LABELS,
    attributes={
        "camera_id": "camera of the match, or broadcast view",
        "unreadable": "[first, last] match frame of each interval without an image",
        "objections": "for each correction, in order: why it does not apply; absent without any",
        **POINT_ATTRIBUTE,
    },
    optional=("objections", *OPTIONAL_POINTS),
)


def detection_unit(camera_id: str, clip_id: str) -> str:
    """Return the name of the unit that detects people in one clip of a static camera."""
    return f"{camera_id}.{clip_id}"


REDETECTION = GroupLayout(
    stage="redetection",
    about="The detections of `detection`, unchanged, followed by people found where the previous "
    "iteration predicts them.",
    coordinates=(FRAME,),
    arrays=(
        *KEYPOINT_ARRAYS,
        *EXTRA_ARRAYS,
        *array_layouts(
            """
            found_again (*frame, detection) int32 [1], missing -1:
                person id of the previous iteration for a redetected person; missing for the
                detections of `detection`
            shift (*frame, detection, joint, axis) float32 [px], missing 0:
                systematic error of the keypoints of redetected people, as in `filtering`
            """
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
