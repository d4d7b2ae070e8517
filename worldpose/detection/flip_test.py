"""Flip test: mean of the poses of an image and of its mirror image, which cancels side bias."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import PoseEstimator

SIDES: Final = (0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15)
"""The COCO-17 joint that each joint becomes in the mirror image."""


class Mirrored:
    """An estimator whose poses are the mean over an image and its mirror image.

    Means are weighted by confidence; a keypoint that only one of the two shows comes from that one.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        self._estimator = estimator

    def estimate(self, picture: Image, boxes: NDArray[np.float64]) -> KeypointDetections:
        """Return the pose in each box."""
        last = picture.shape[1] - 1
        seen = self._estimator.estimate(picture, boxes)
        mirror = self._estimator.estimate(
            np.ascontiguousarray(picture[:, ::-1]), _turned(boxes, last)
        )
        back = mirror.keypoints[:, SIDES] * [-1.0, 1.0] + [last, 0.0]
        both = np.stack([seen.keypoints, back])
        weights = np.nan_to_num(np.stack([seen.confidence, mirror.confidence[:, SIDES]]))
        total = weights.sum(axis=0)
        found = total > 0.0
        mean = np.nansum(both * weights[..., None], axis=0) / np.where(found, total, 1.0)[..., None]
        confidence = total / np.maximum((weights > 0.0).sum(axis=0), 1)
        keypoints = np.where(found[..., None], mean, np.nan)
        confidence = np.where(found, confidence, np.nan)
        middle = 0.5 * (seen.boxes + _turned(mirror.boxes, last))
        return KeypointDetections(keypoints, confidence, middle, 0.5 * (seen.score + mirror.score))


def _turned(boxes: NDArray[np.floating], last: int) -> NDArray[np.float64]:
    """Return boxes (people, 4) in the mirror image of a frame whose last column is `last` [px]."""
    return np.asarray(boxes[:, [2, 1, 0, 3]] * [-1.0, 1.0, -1.0, 1.0] + [last, 0.0, last, 0.0])
