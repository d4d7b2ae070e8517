"""The two things that know how to look: a detector of people and an estimator of their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""(height, width, 3) RGB."""

LEAST_SCORE: Final = 0.05
"""A detector reports every box from this score on; what is kept is decided by the stage."""


@dataclass(frozen=True)
class People:
    """People found in one picture.

    Attributes:
        boxes: (people, 4) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel.
        scores: (people,) in (0, 1].
    """

    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]


@dataclass(frozen=True)
class Poses:
    """Keypoints of some people of one picture.

    Attributes:
        keypoints: (people, 17, 2) COCO-17 [px]; NaN where not found.
        confidence: (people, 17) in (0, 1]; NaN where not found.
        boxes: (people, 4) as the estimator sees them, who looks closer than a detector [px]; None
            from one that sees joints alone.
        fit: (people,) how much of their union these and the true boxes share, as expected [1].
    """

    keypoints: NDArray[np.float64]
    confidence: NDArray[np.float64]
    boxes: NDArray[np.float64] | None = None
    fit: NDArray[np.float64] | None = None


class Detector(Protocol):
    """Finds people in pictures; the same pictures give the same people."""

    @property
    def view_size(self) -> tuple[int, int] | None:
        """Width, height of the pictures it takes best [px]; None where any size does.

        Larger pictures are cut into views of this size, which overlap, before they come here.
        """

    def detect(self, pictures: Sequence[Picture]) -> list[People]:
        """The people of each picture, from `LEAST_SCORE` on.

        Args:
            pictures: of one size. How many are computed at once is for the detector to decide;
                a person must not depend on what else is in the batch.
        """


class PoseEstimator(Protocol):
    """Finds the keypoints of people whose boxes are known."""

    def estimate(self, picture: Picture, boxes: NDArray[np.float64]) -> Poses:
        """The pose of each box, in the picture's pixels; keypoints may lie outside of their box.

        Args:
            picture: the whole picture.
            boxes: (people, 4) x0, y0, x1, y1 [px]; may reach over the picture's border. Nobody
                is a legal request.
        """


@runtime_checkable
class LooksBeside(PoseEstimator, Protocol):
    """An estimator that also finds whom others hide from a detector."""

    def beside(self, picture: Picture, people: People) -> tuple[People, Poses]:
        """Who stands beside people of a picture and is none of them, with boxes seen from near.

        Args:
            picture: the whole picture.
            people: who was found in it.
        """
