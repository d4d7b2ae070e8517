"""Scale and temporal correlation of keypoint errors, from the residuals of an adjustment."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.building import KeypointNoise
from worldpose.bundle_adjustment.clip import Observed
from worldpose.geometry import Camera

_MEDIAN: Final = 2.0 * np.log(2.0)
"""Median squared length of a standard Gaussian in two dimensions [1]."""


def residuals(
    cameras: Camera, points: NDArray[np.float64], observed: Observed
) -> NDArray[np.float64]:
    """Return projected minus observed (n, 2) in stated standard deviations [1].

    Args:
        cameras: (cameras,) batch.
        points: (points, 3) [m], world.
        observed: keypoints of these points.
    """
    off = np.empty_like(observed.image)
    for c in range(len(cameras.focal)):
        rows = observed.camera_of == c
        off[rows] = cameras[c].project(points[observed.point_of[rows]]) - observed.image[rows]
    return off / observed.noise[:, None]


def measured_noise(
    cameras: Camera, points: NDArray[np.float64], observed: Observed, robust_scale: float
) -> KeypointNoise:
    """Return the scale and the correlation of the keypoints' errors.

    The scale comes from the median; every point takes three degrees of freedom out of its
    observations. The correlation is the squared length of the sum of a joint's residuals over time,
    in one camera, over the sum of their squared lengths; 1 for independent residuals.

    Args:
        cameras: (cameras,) batch, adjusted.
        points: (points, 3) [m], world, adjusted.
        observed: keypoints of these points.
        robust_scale: of Cauchy's loss [standard deviations].
    """
    off = residuals(cameras, points, observed)
    views = np.bincount(observed.point_of, minlength=len(points))[observed.point_of]
    squared = (off**2).sum(axis=1) / (1.0 - 1.5 / np.maximum(views, 2))
    scale = float(np.sqrt(np.median(squared[views > 2]) / _MEDIAN)) if (views > 2).any() else 1.0
    pull = off / (1.0 + (off**2).sum(axis=1) / (robust_scale * scale) ** 2)[:, None]
    series = (observed.camera_of * (observed.person_of.max() + 1) + observed.person_of) * 17
    _, series = np.unique(series + observed.joint_of, return_inverse=True)
    summed = np.stack([np.bincount(series, pull[:, axis]) for axis in range(2)])
    correlation = float((summed**2).sum() / (pull**2).sum())
    return KeypointNoise(scale, max(1.0, correlation))
