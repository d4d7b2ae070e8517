"""Redetection of people at the predicted projections of their bodies (R2).

Input: bodies of the previous iteration in one camera's frames, its detections, a pose estimator.
Output: the people searched for, the estimator's results, and the accepted ones.
"""

from worldpose.redetection.search_results import (
    Expected,
    MissingPeople,
    RedetectionSettings,
    Verdicts,
    find_detected_people,
    judge_search_results,
    search_missing_people,
    select_missing_people,
)

__all__ = [
    "Expected",
    "MissingPeople",
    "RedetectionSettings",
    "Verdicts",
    "find_detected_people",
    "judge_search_results",
    "search_missing_people",
    "select_missing_people",
]
