"""Common camera center of several clips of one match, if they are consistent (M1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.uncertainty import Uncertainty

_UNLIKELY = 1e-3
"""Significance level of the test that clips have one center [1]."""


@dataclass(frozen=True, eq=False)
class PooledCenter:
    """Common camera center of several clips.

    Attributes:
        center: (3,) [m], world; NaN if the clips are inconsistent.
        covariance: (3, 3) [m^2].
        agree: whether one center explains all clips.
        distance: (clips,) Mahalanobis distance of each clip from the common center.
    """

    center: Floats
    covariance: Floats
    agree: bool
    distance: Floats


def pool_centers(centers: Sequence[Floats], covariances: Sequence[Floats]) -> PooledCenter:
    """Return the covariance-weighted mean of several clips' centers.

    Args:
        centers: (3,) each [m], world.
        covariances: (3, 3) each [m^2].
    """
    information = [np.linalg.inv(covariance) for covariance in covariances]
    whole = np.linalg.inv(np.sum(information, axis=0))
    middle = whole @ np.sum([i @ c for i, c in zip(information, centers, strict=True)], axis=0)
    squared = np.array(
        [(c - middle) @ i @ (c - middle) for c, i in zip(centers, information, strict=True)]
    )
    freedom = 3 * (len(centers) - 1)
    agree = freedom == 0 or bool(squared.sum() < chdtri(freedom, _UNLIKELY))
    nothing = np.full(3, np.nan)
    return PooledCenter(middle if agree else nothing, np.asarray(whole), agree, np.sqrt(squared))


def drawn_to(
    camera: MovingCamera, uncertainty: Uncertainty, pooled: PooledCenter
) -> tuple[MovingCamera, Uncertainty]:
    """Return a clip's cameras conditioned on the pooled center, and their covariance.

    Rotation, focal length and distortion follow the center by their covariance with it.

    Args:
        camera: all frames of the clip.
        uncertainty: its covariance.
        pooled: common center of consistent clips, this clip included.
    """
    known = uncertainty.frame
    place = slice(FRAME_SIZE, FRAME_SIZE + 3)
    along = known[:, :, place] @ np.linalg.inv(known[:, place, place])
    step = along @ (pooled.center - camera.center)
    moved = camera.stepped(step[:, :FRAME_SIZE], step[0, FRAME_SIZE:])
    gained = known[:, place, place] - pooled.covariance
    left = known - along @ gained @ np.swapaxes(along, -1, -2)
    return moved, Uncertainty(0.5 * (left + np.swapaxes(left, -1, -2)))
