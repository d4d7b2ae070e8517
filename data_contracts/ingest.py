"""Result of stage `ingest`: the detections or the video index of one camera."""

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

VIDEO_ARRAYS = array_layouts(
    """
    picture_of_frame (frame) int64 [1], missing -1:
        number of the video image that shows this match frame
    picture_stamp (picture) int64 [1]:
        presentation time stamp of each image in display order, in units of the time base
    picture_key (picture) bool [1]:
        whether decoding can begin at this image
    """
)
"""The index of a video, and its mapping to match frames."""

INGEST = GroupLayout(
    stage="ingest",
    about="Given 2D poses of one camera, or the index of its video, by match frame.",
    coordinates=(FRAME,),
    arrays=(*KEYPOINT_ARRAYS, *EXTRA_ARRAYS, *VIDEO_ARRAYS),
    labels=KEYPOINT_LABELS,
    attributes={
        "camera_id": "camera of the match, or broadcast view",
        "video": "null, or a video's time_base [1, units per second], size [px], missing_frames, "
        "and is_counted if frames are known only by counting from the first",
        "left_out": "why the video cannot be read; null if it can",
        "objections": "for each correction, in order: why it does not apply; absent without any",
        **POINT_ATTRIBUTE,
    },
    optional=(
        *(array.name for array in (*KEYPOINT_ARRAYS, *VIDEO_ARRAYS)),
        *("objections", *OPTIONAL_POINTS),
    ),
)
