"""Projections of fitted bodies into static cameras, with variance, and residuals of keypoints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.geometry import Camera

Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of keypoints, one row per detection; joints are those of the body.

    Attributes:
        frame: (n,)
        camera: (n,)
        person: (n,)
        missed: (n, 17, 2) vector from the body to the keypoint [px]; NaN = does not count.
        variance: (n, 17) variance of this vector per axis [px^2].
        repeated: rows of a person with correlated errors, which count as one.
    """

    frame: Places
    camera: Places
    person: Places
    missed: Floats
    variance: Floats
    repeated: float

    @property
    def weight(self) -> Floats:
        """(n, 17) [1/px^2]; 0 = does not count."""
        there = np.isfinite(self.missed).all(axis=-1) & np.isfinite(self.variance)
        return np.where(there, 1.0 / (np.where(there, self.variance, 1.0) * self.repeated), 0.0)

    def less(self, shift: Floats) -> Residuals:
        """Return the residuals minus a shift (n, 17, 2) [px]."""
        return replace(self, missed=self.missed - shift)


@dataclass(frozen=True, eq=False)
class BodyViews:
    """Projected bodies, (frames, cameras, persons, 17) each."""

    image: Floats
    """(..., 2) [px]; NaN without a body in front of the camera."""
    variance: Floats
    """Variance of `image` [px^2], mean over both axes."""
    scale: Floats
    """Image scale there [px/m]."""


def perceived_covariance(covariance: Floats, common_bias: Floats) -> Floats:
    """Return the covariance of the detector's joints of bodies (frames, persons, 17, 3, 3).

    The offsets follow the detector's joints, so the common bias is no part of the covariance.

    Args:
        covariance: (frames, persons, 17, 3, 3) [m^2], of the bodies' joints.
        common_bias: (17,) per axis, error that all views share [m]; included in `covariance`.
    """
    seen: Floats = covariance - common_bias[:, None, None] ** 2 * np.eye(3)
    return seen


def view_bodies(cameras: Camera, joints: Floats, covariance: Floats) -> BodyViews:
    """Return projections of bodies into all images.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world, the detector's joints; NaN without a body.
        covariance: (frames, persons, 17, 3, 3) [m^2].
    """
    frames, persons = joints.shape[:2]
    count = cameras.batch_shape[0]
    shape = (frames, count, persons, joints.shape[2])
    image = cameras.project(joints.reshape(frames, 1, -1, 3)).reshape(*shape, 2)
    ahead = cameras.cam_from_world.rotation[:, 2]
    depth = np.einsum("ca,fpja->fcpj", ahead, joints)
    depth += cameras.cam_from_world.translation[:, 2, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = cameras.focal.mean(axis=-1)[:, None, None] / depth
    total = np.einsum("...aa", covariance)[:, None]
    along = np.einsum("ca,fpjab,cb->fcpj", ahead, covariance, ahead)
    # The optical axis replaces each line of sight of the image: the relative error of the variance
    # is the squared sine of the angle between them.
    variance = 0.5 * (total - along) * scale**2
    return BodyViews(image, variance, scale)
