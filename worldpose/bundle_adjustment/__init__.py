"""Bundle adjustment: joint refinement of all cameras and some 3D joints (B1-B3).

Input: calibrated cameras, tracked and triangulated people, clicked markings. Output: cameras that
fit both, accepted only where they reduce the residuals of held-out people.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.bundle_adjustment.adjustment import BundleAdjustment, adjust_cameras
    from worldpose.bundle_adjustment.clip import Clicks, Clip, propose_frames
    from worldpose.bundle_adjustment.report import (
        ClickReview,
        KeypointOutliers,
        adjustment_arrays,
        keypoint_outliers,
        marking_errors,
        review_clicks,
    )
    from worldpose.bundle_adjustment.settings import (
        BundleAdjustmentSettings,
        GivenCameraPrior,
        SolverSettings,
    )
    from worldpose.bundle_adjustment.solver import Problem, Solution, solve
    from worldpose.bundle_adjustment.uncertainty import WeakDirection, weak_direction

__all__ = [
    "BundleAdjustment",
    "BundleAdjustmentSettings",
    "ClickReview",
    "Clicks",
    "Clip",
    "GivenCameraPrior",
    "KeypointOutliers",
    "Problem",
    "Solution",
    "SolverSettings",
    "WeakDirection",
    "adjust_cameras",
    "adjustment_arrays",
    "keypoint_outliers",
    "marking_errors",
    "propose_frames",
    "review_clicks",
    "solve",
    "weak_direction",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.bundle_adjustment.adjustment": (
            "BundleAdjustment",
            "adjust_cameras",
        ),
        "worldpose.bundle_adjustment.clip": (
            "Clicks",
            "Clip",
            "propose_frames",
        ),
        "worldpose.bundle_adjustment.report": (
            "ClickReview",
            "KeypointOutliers",
            "adjustment_arrays",
            "keypoint_outliers",
            "marking_errors",
            "review_clicks",
        ),
        "worldpose.bundle_adjustment.settings": (
            "BundleAdjustmentSettings",
            "GivenCameraPrior",
            "SolverSettings",
        ),
        "worldpose.bundle_adjustment.solver": (
            "Problem",
            "Solution",
            "solve",
        ),
        "worldpose.bundle_adjustment.uncertainty": (
            "WeakDirection",
            "weak_direction",
        ),
    },
)
