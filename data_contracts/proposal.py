"""Result of stage `proposal`: a camera without a click, and the people in its images."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout, array_layouts
from data_contracts.cameras import CAMERA_ARRAYS, CAMERA_LABELS
from data_contracts.keypoints import FRAME

_PLACES = array_layouts(
    """
    place (frame, detection, coordinate_2d) float64 [m], missing nan:
        x, y of people on the pitch, world, with the camera on the assumed side
    place_covariance (frame, detection, coordinate_2d, coordinate_2d_) float64 [m^2], missing nan:
        covariance of `place` by the error of feet in the image
    """
)

PROPOSAL = GroupLayout(
    stage="proposal",
    about="One static camera before its calibration, and the places of people in a few frames by "
    "their feet. They decide on which side of the pitch the cameras stand. A camera without a "
    "stated side is assumed on the near side. Without a camera there are no arrays; `problem` "
    "says why.",
    coordinates=(FRAME,),
    arrays=(*CAMERA_ARRAYS, *_PLACES),
    labels={**CAMERA_LABELS, "coordinate_2d": ("x", "y"), "coordinate_2d_": ("x", "y")},
    attributes={
        "camera_id": "camera of the match",
        "origin": "given, points (clicked), image (proposed from the image alone), or none",
        "is_stated": "whether match.yaml, clicks or a given camera state the side",
        "is_clear": "whether the camera may be used without a click",
        "problem": "where, expected, found and todo of the error without a camera; else null",
        "fps": "frames per second of match time [1/s]",
        "drawn": "pixels on the paint of every marking that was found [px], by name",
        "markings": "name, visible length [px] and share on paint [1] of each expected marking",
        "score": "log probability ratio of the paint to an image without a pitch [1]; null unless "
        "proposed",
        "margin": "score above the best other camera [1]; null unless proposed",
        "found": "share of the expected markings on paint [1]; null unless proposed",
        "explained": "share of the straight paint on a marking [1]; null unless proposed",
    },
    optional=("frame", *(array.name for array in CAMERA_ARRAYS), "place", "place_covariance"),
)
