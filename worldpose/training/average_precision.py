"""Average precision of boxes at one overlap (COCO's AP50)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.detection.boxes import overlaps
from worldpose.detection.interfaces import People
from worldpose.training.labels import LabelledPicture

OVERLAP: Final = 0.5
"""Least intersection over union of a true positive [1]."""


def average_precision(
    found: Sequence[People],
    labels: Sequence[LabelledPicture],
    heights: tuple[float, float] = (0.0, np.inf),
) -> float:
    """Return the area under the curve of precision over recall [1]; NaN without wanted people.

    As in COCO: the best boxes choose first, each the person it overlaps most. People who are
    ignored or of other heights, and boxes on them, count neither as true nor as false positives;
    nor do boxes of other heights that match no person. Precision is made to fall with recall, and
    integrated at every step of recall instead of at COCO's 101 points.

    Args:
        found: detections in each image.
        labels: the truth of the same images.
        heights: range of wanted people, lower bound included, upper not [px].
    """
    scores, right = [], []
    asked = 0
    for people, picture in zip(found, labels, strict=True):
        tall = picture.boxes[:, 3] - picture.boxes[:, 1]
        wanted = ~picture.ignored & (tall >= heights[0]) & (tall < heights[1])
        asked += int(wanted.sum())
        order = np.argsort(-people.scores, kind="stable")
        verdict = _judged(people.boxes[order], picture.boxes, wanted)
        own = people.boxes[order, 3] - people.boxes[order, 1]
        stray = (verdict == 0) & ((own < heights[0]) | (own >= heights[1]))
        counted = (verdict >= 0) & ~stray
        scores.append(people.scores[order][counted])
        right.append(verdict[counted] == 1)
    if asked == 0:
        return np.nan
    order = np.argsort(-np.concatenate(scores), kind="stable")
    hits = np.concatenate(right)[order]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(best[hits].sum() / asked)


def _judged(boxes: Floats, true: Floats, wanted: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return per box, best first: 1 true positive, 0 false positive, -1 on an ignored person."""
    verdict = np.zeros(len(boxes), dtype=np.int64)
    if not len(true):
        return verdict
    overlap = overlaps(boxes, true)
    free = wanted.copy()
    for index, row in enumerate(overlap):
        best = int(np.where(free, row, -1.0).argmax())
        if free[best] and row[best] >= OVERLAP:
            verdict[index], free[best] = 1, False
        elif np.any(row[~wanted] >= OVERLAP):
            verdict[index] = -1
    return verdict
