"""Bundle adjustment: joint refinement of all cameras and some 3D joints (B1-B3).

Input: calibrated cameras, tracked and triangulated people, clicked markings. Output: cameras that
fit both, accepted only where they reduce the residuals of held-out people.
"""

from worldpose.bundle_adjustment.adjusting import BundleAdjustment, adjust_cameras
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.bundle_adjustment.directions import WeakDirection, weak_direction
from worldpose.bundle_adjustment.frames import propose_frames
from worldpose.bundle_adjustment.outliers import (
    ClickReview,
    KeypointOutliers,
    keypoint_outliers,
    review_clicks,
)
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, GivenCameraPrior
from worldpose.bundle_adjustment.solving import Adjusted, Problem, SolverSettings, solve
from worldpose.bundle_adjustment.stored import adjustment_arrays, marking_errors

__all__ = [
    "Adjusted",
    "BundleAdjustment",
    "BundleAdjustmentSettings",
    "ClickReview",
    "Clicks",
    "Clip",
    "GivenCameraPrior",
    "KeypointOutliers",
    "Problem",
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
