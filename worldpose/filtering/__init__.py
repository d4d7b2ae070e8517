"""Filtering: which detected keypoints and boxes the fitted bodies contradict (R2).

Input: fitted bodies, the cameras, what they detected and who was taken for whom. Output: keypoints
and boxes that the next iteration leaves out, and how well cameras that were left out are foreseen.
"""

from worldpose.filtering.held_out import HeldOut, measure_held_out
from worldpose.filtering.judging import Judgement, Suspects, judge_detections, learn_from
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.spread import Spread
from worldpose.filtering.views import BodyViews, perceived_joints, view_bodies

__all__ = [
    "BodyViews",
    "FilteringSettings",
    "HeldOut",
    "Judgement",
    "Spread",
    "Suspects",
    "judge_detections",
    "learn_from",
    "measure_held_out",
    "perceived_joints",
    "view_bodies",
]
