"""Filtering: which detected keypoints and boxes the fitted bodies contradict (R2).

Input: fitted bodies, the cameras, what they detected and who was taken for whom. Output: what the
next iteration leaves out or takes off keypoints, and how well left-out cameras are foreseen.
"""

from worldpose.filtering.held_out import HeldOut, measure_held_out
from worldpose.filtering.judging import Judgement, Suspects, judge_detections, learn_from
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.spread import Spread
from worldpose.filtering.systematic_errors import (
    BodyMotion,
    SystematicErrors,
    learn_systematic_errors,
    watch_motion,
)
from worldpose.filtering.view_bias import ViewBias
from worldpose.filtering.views import (
    BodyViews,
    perceived_covariance,
    perceived_joints,
    view_bodies,
)

__all__ = [
    "BodyMotion",
    "BodyViews",
    "FilteringSettings",
    "HeldOut",
    "Judgement",
    "Spread",
    "Suspects",
    "SystematicErrors",
    "ViewBias",
    "judge_detections",
    "learn_from",
    "learn_systematic_errors",
    "measure_held_out",
    "perceived_covariance",
    "perceived_joints",
    "view_bodies",
    "watch_motion",
]
