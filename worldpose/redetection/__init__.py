"""Redetection of people at the predicted projections of their bodies (R2).

Input: bodies of the previous iteration in one camera's frames, its detections, a pose estimator.
Output: the people searched for, the estimator's results, and the accepted ones.
"""

from worldpose.redetection.answers import Verdicts, judge_answers, look_again
from worldpose.redetection.expected import Expected
from worldpose.redetection.settings import RedetectionSettings
from worldpose.redetection.sought import Sought, who_is_seen, whom_to_seek

__all__ = [
    "Expected",
    "RedetectionSettings",
    "Sought",
    "Verdicts",
    "judge_answers",
    "look_again",
    "who_is_seen",
    "whom_to_seek",
]
