"""Which detections nobody has looked at yet, the least certain first (D4, D6)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.review import Acceptance
from worldpose.review.detections import DetectionEdit


@dataclass(frozen=True, eq=False)
class OpenDetections:
    """Detections that nobody accepted or corrected, the least certain first.

    Attributes:
        frame: (n,) match frames.
        detection: (n,) places among the detections of the frame.
        score: (n,) the detector's confidence [1].
        people: all detections, looked at or not.
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
    """Return what is left to look at of one result of a camera.

    Args:
        frame: (frames,) match frames, rising without gaps.
        score: (frames, detections) without corrections; NaN where nobody is.
        acceptances: of this result.
        edits: of this camera: whom a person corrected, that person looked at.
    """
    there = np.isfinite(score)
    waits = there.copy()
    first = int(frame[0]) if len(frame) else 0
    looked_at = [(edit.frame, edit.detection) for edit in edits]
    for acceptance in acceptances:
        looked_at += acceptance.people
        if acceptance.at_least is not None:
            # Scores are stored in single precision, and a person names what a page shows.
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
