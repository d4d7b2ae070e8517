"""Detections that await review, by rising confidence (D4, D6)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.review import Acceptance
from worldpose.review.detections import DetectionEdit


@dataclass(frozen=True, eq=False)
class OpenDetections:
    """Detections without acceptance or correction, by rising confidence.

    Attributes:
        frame: (n,) match frames.
        detection: (n,) indices of the detections in the frame.
        score: (n,) the detector's confidence [1].
        people: number of all detections, reviewed or not.
    """

    frame: NDArray[np.int64]
    detection: NDArray[np.int64]
    score: NDArray[np.float64]
    people: int


def open_detections(
    frame: NDArray[np.int64],
    score: NDArray[np.floating],
    acceptances: Iterable[Acceptance],
    edits: Iterable[DetectionEdit],
) -> OpenDetections:
    """Return the detections of one camera's result that await review.

    Args:
        frame: (frames,) match frames, rising without gaps.
        score: (frames, detections) without corrections; NaN = no detection.
        acceptances: of this result.
        edits: of this camera; a corrected detection counts as reviewed.
    """
    there = np.isfinite(score)
    waits = there.copy()
    first = int(frame[0]) if len(frame) else 0
    looked_at = [(edit.frame, edit.detection) for edit in edits]
    for acceptance in acceptances:
        looked_at += acceptance.people
        if acceptance.at_least is not None:
            # The store has scores in single precision, and a person enters the displayed value.
            waits &= ~(score >= np.float32(acceptance.at_least))
    for number, detection in looked_at:
        row = number - first
        if 0 <= row < score.shape[0] and 0 <= detection < score.shape[1]:
            waits[row, detection] = False
    rows, places = np.nonzero(waits)
    values = score[rows, places].astype(np.float64)
    order = np.argsort(values, kind="stable")
    return OpenDetections(
        frame=frame[rows[order]],
        detection=places[order].astype(np.int64),
        score=values[order],
        people=int(np.count_nonzero(there)),
    )
