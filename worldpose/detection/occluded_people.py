"""Occluded people, found in crops shifted to the side of every detected person."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.boxes import best_of, overlaps, suppress
from worldpose.detection.bundled_looks import Look
from worldpose.detection.interfaces import People

SURE: Final = 0.25
"""Score of a detection from which on its neighbourhood is searched [1]."""
STEP: Final = 0.35
"""Shift to either side, as a share of the box's width [1], for people who are half occluded.
Closer, the net shows the detected person; farther, detectors find the other without help."""
CROWDED: Final = 0.6
"""If another detection overlaps the shifted box more, there is no room for a further person [1,
intersection over union]."""
SAME: Final = 0.7
"""A box that overlaps a detected person more is that person [1, intersection over union]."""
WORTH: Final = 0.15
"""Below this product of fit and surest keypoints a result gets no second crop [1]."""
THERE: Final = 0.4
"""From this product on a result is a person [1]. In scenes like those of training, one in five of
the results kept is a new person; of detector boxes with such scores, one in four is."""
ONE: Final = 0.5
"""Two occluded people that overlap more are one [1, intersection over union]."""
UNSEEN: Final = 0.3
"""Replaces the score of the detector, which does not see these people [1]."""


def find_occluded_people(
    look: Callable[[Floats, Sequence[Floats]], Look], people: People
) -> KeypointDetections:
    """Return occluded people next to detected ones that the detector missed, with their poses.

    The net takes a target box and the boxes of its neighbours. It first runs on boxes a step to
    either side of every detected person, then a second time on the boxes that it returned.

    Args:
        look: returns the net's output for boxes (people, 4) [px], given the neighbours' boxes of
            each.
        people: detected people, with the estimator's boxes.

    Note:
        Iterative detection conditioned on earlier detections: Rukhovich et al., IterDet, 2020.
    """
    sure = people.scores >= SURE
    known = suppress(People(people.boxes[sure], people.scores[sure]), SAME).boxes
    step = STEP * (known[:, 2] - known[:, 0])[:, None] * [1.0, 0.0, 1.0, 0.0]
    asked = np.concatenate([known - step, known + step])
    shares = overlaps(asked, known)
    shares[np.tile(np.eye(len(known), dtype=np.bool_), (2, 1))] = 0.0
    asked = asked[shares.max(axis=1, initial=0.0) <= CROWDED]
    seen = look(asked, [known[row > 0.0] for row in overlaps(asked, known)])
    boxes = seen.boxes[_others(seen, known, WORTH)]
    seen = look(boxes, [known[row <= SAME] for row in overlaps(boxes, known)])
    seen = seen.only(_others(seen, known, THERE))
    seen = seen.only(best_of(People(seen.boxes, seen.score), ONE))
    likeliest = np.zeros(seen.places.shape[:2], dtype=np.intp)
    return replace(seen.poses(likeliest), score=np.cbrt(UNSEEN * seen.score))


def _others(seen: Look, known: Floats, least: float) -> NDArray[np.bool_]:
    """Return whether a result shows a person other than the known ones (people,)."""
    real = np.all(seen.boxes[:, 2:] - seen.boxes[:, :2] > 1.0, axis=1)
    apart = overlaps(seen.boxes, known).max(axis=1, initial=0.0) < SAME
    return np.asarray(real & apart & (seen.score >= least))
