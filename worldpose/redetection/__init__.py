"""Redetection: people looked for again where bodies say that a camera must show them (R2).

Input: bodies of the iteration before in one camera's pictures, whom it detected, a pose estimator.
Output: whom it was asked for, what it answered, and which of the answers are theirs.
"""

from worldpose.redetection.answers import Answers, Verdicts, judge_answers, look_again
from worldpose.redetection.expected import Expected
from worldpose.redetection.settings import RedetectionSettings
from worldpose.redetection.sought import Sought, who_is_seen, whom_to_seek

__all__ = [
    "Answers",
    "Expected",
    "RedetectionSettings",
    "Sought",
    "Verdicts",
    "judge_answers",
    "look_again",
    "who_is_seen",
    "whom_to_seek",
]
