"""Filtering: which detected keypoints and boxes the fitted bodies contradict (R2).

Input: fitted bodies, the cameras, what they detected and who was taken for whom. Output: what the
next iteration leaves out or takes off keypoints, and how well left-out cameras are foreseen.
"""

from worldpose.filtering.habits import BodyMotion, Habits, learn_habits, watch_motion
from worldpose.filtering.held_out import HeldOut, measure_held_out
from worldpose.filtering.judging import Judgement, Suspects, judge_detections, learn_from
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.spread import Spread
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
    "Habits",
    "HeldOut",
    "Judgement",
    "Spread",
    "Suspects",
    "ViewBias",
    "judge_detections",
    "learn_from",
    "learn_habits",
    "measure_held_out",
    "perceived_covariance",
    "perceived_joints",
    "view_bodies",
    "watch_motion",
]
