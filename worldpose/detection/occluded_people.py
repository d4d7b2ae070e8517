"""People whom others hide: asked for a step to the side of everybody who was found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.detection.boxes import best_of, overlaps, suppress
from worldpose.detection.bundled_looks import Look
from worldpose.detection.interfaces import People, Poses

Floats = NDArray[np.float64]

SURE: Final = 0.25
"""Beside whom is found with this score somebody may stand [1]."""
STEP: Final = 0.35
"""How far to either side one is asked for, as a share of the box's width [1]: people whom others
hide by half. Closer, the net shows who was found; farther, detectors find them by themselves."""
CROWDED: Final = 0.6
"""Where a box found shares more with the one to be asked about, nobody else is [1, intersection
over union]."""
SAME: Final = 0.7
"""Who shares more with a person found is that person [1, intersection over union]."""
WORTH: Final = 0.15
"""Below this product of fit and surest keypoints an answer is not asked for its own [1]."""
THERE: Final = 0.4
"""From this product on somebody is there [1]. Of those stored on scenes of training's kind one in
five is a new person's; of boxes that a detector finds, with such scores, one in four is."""
ONE: Final = 0.5
"""Two who are found beside others and share more are one [1, intersection over union]."""
UNSEEN: Final = 0.3
"""What stands for the score of the detector, which does not see them [1]."""


def find_occluded_people(
    look: Callable[[Floats, Sequence[Floats]], Look], people: People
) -> tuple[People, Poses]:
    """Return those who are beside people found and were not found themselves, with their poses.

    A net that is told who stands about answers of the one who is asked for. So it is asked, told
    of everybody found, about boxes a step to either side; what it then sees is asked about again.

    Args:
        look: shows what is in boxes (people, 4) [px], told of the boxes of others about each.
        people: who was found, with boxes as seen from near.

    Note:
        Iterative detection told of what is found: Rukhovich et al., IterDet, 2020.
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
    return People(seen.boxes, np.cbrt(UNSEEN * seen.score)), seen.poses(likeliest)


def _others(seen: Look, known: Floats, least: float) -> NDArray[np.bool_]:
    """Whether somebody is seen who is none of those known (people,)."""
    real = np.all(seen.boxes[:, 2:] - seen.boxes[:, :2] > 1.0, axis=1)
    apart = overlaps(seen.boxes, known).max(axis=1, initial=0.0) < SAME
    return np.asarray(real & apart & (seen.score >= least))
