"""Detector bias as a function of the direction from which a camera sees a body.

From the side, a detector puts a hip closer to the front than from ahead: an error that all people
and cameras share and that more views of the same side do not average out. Bodies fitted to all
views reveal it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body_fitting.shared_bias import body_axes
from worldpose.filtering.residuals import Residuals
from worldpose.geometry import Camera

WAVES: Final = (2, 3)
"""Harmonics of the azimuth. A constant bias and the first harmonic are those of a point next to the
joint, which the offsets of body fitting cover; higher harmonics would let the bias vary within a
sixth of a turn."""
TERMS: Final = 2 * len(WAVES)
EXPECTED: Final = 0.02
"""Prior standard deviation of each coefficient [m]: a hundredth of a body."""


@dataclass(frozen=True, eq=False)
class ViewBias:
    """Bias of keypoints by viewing direction.

    Attributes:
        coefficient: (17, 2, 4) [m], of each joint along the image axes: cosines, then sines, of the
            multiples of the azimuth in `WAVES`.
    """

    coefficient: Floats

    @classmethod
    def none(cls) -> ViewBias:
        """Return the zero bias of a detector with equal errors from all directions."""
        return cls(np.zeros((17, 2, TERMS)))

    def shift(self, azimuth: NDArray[np.floating], scale: NDArray[np.floating]) -> Floats:
        """Return the bias of keypoints (..., 17, 2) [px].

        Args:
            azimuth: (...) of the camera seen from the body [rad]; NaN = unknown.
            scale: (...) [px/m].
        """
        waves = _waves(azimuth) * np.asarray(scale)[..., None]
        return np.asarray(np.einsum("...w,jaw->...ja", waves, self.coefficient))


def find_azimuths(cameras: Camera, joints: Floats) -> Floats:
    """Return the azimuth of each camera as seen from bodies (frames, cameras, persons) [rad].

    0 is in front of a body, a quarter turn to its left; NaN without a body.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world.
    """
    axes = body_axes(joints)
    middle = joints[..., (5, 6, 11, 12), :].mean(axis=-2)
    away = cameras.center[:, None] - middle[:, None]
    ahead, left = (np.einsum("fcpa,fpa->fcp", away, axes[..., k]) for k in (0, 1))
    return np.asarray(np.arctan2(left, ahead))


def learn_view_bias(residuals: Residuals, azimuth: Floats, scale: Floats) -> ViewBias:
    """Return the bias by viewing direction, from linear least squares.

    Args:
        residuals: of bodies.
        azimuth: (n,) [rad], of each row.
        scale: (n,) [px/m].
    """
    weight = residuals.weight * (np.isfinite(azimuth) & np.isfinite(scale))[:, None]
    waves = np.nan_to_num(_waves(azimuth) * scale[:, None])
    missed = np.where(weight[..., None] > 0.0, residuals.missed, 0.0)
    matrix = np.einsum("nw,nj,nv->jwv", waves, weight, waves, optimize=True)
    right = np.einsum("nw,nj,nja->jwa", waves, weight, missed, optimize=True)
    matrix = matrix + np.eye(TERMS) / EXPECTED**2
    return ViewBias(np.linalg.solve(matrix, right).swapaxes(-1, -2).astype(np.float64))


def _waves(azimuth: NDArray[np.floating]) -> Floats:
    angles = np.asarray(azimuth, dtype=np.float64)[..., None] * np.array(WAVES)
    return np.concatenate([np.cos(angles), np.sin(angles)], axis=-1)
