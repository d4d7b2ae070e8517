"""Filtering: detected keypoints and boxes that contradict the fitted bodies (R2).

Input: fitted bodies, cameras, detections and their matches to people. Output: keypoints to leave
out and corrections to subtract in the next iteration, and prediction errors in held-out cameras.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.filtering.judging import (
        BodyViews,
        HeldOut,
        Judgement,
        Spread,
        TriangulatedDetections,
        judge_detections,
        learn_keypoint_spread,
        measure_held_out,
        perceived_covariance,
        view_bodies,
    )
    from worldpose.filtering.settings import FilteringSettings
    from worldpose.filtering.systematic_errors import (
        BodyMotion,
        SystematicErrors,
        ViewBias,
        learn_systematic_errors,
        watch_motion,
    )

__all__ = [
    "BodyMotion",
    "BodyViews",
    "FilteringSettings",
    "HeldOut",
    "Judgement",
    "Spread",
    "SystematicErrors",
    "TriangulatedDetections",
    "ViewBias",
    "judge_detections",
    "learn_keypoint_spread",
    "learn_systematic_errors",
    "measure_held_out",
    "perceived_covariance",
    "view_bodies",
    "watch_motion",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.filtering.judging": (
            "BodyViews",
            "perceived_covariance",
            "view_bodies",
            "HeldOut",
            "measure_held_out",
            "Judgement",
            "Spread",
            "TriangulatedDetections",
            "judge_detections",
            "learn_keypoint_spread",
        ),
        "worldpose.filtering.settings": ("FilteringSettings",),
        "worldpose.filtering.systematic_errors": (
            "BodyMotion",
            "SystematicErrors",
            "ViewBias",
            "learn_systematic_errors",
            "watch_motion",
        ),
    },
)
