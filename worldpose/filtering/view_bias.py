"""What a detector gets wrong by the side that it sees a body from.

A hip seen from the side is taken for a point nearer to the front than one seen from ahead: an error
that all people and cameras have in common and that no further view of the same side averages out.
Bodies that all views agree on show it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body_fitting.shared_bias import body_axes
from worldpose.cameras import Camera
from worldpose.filtering.residuals import Residuals

Floats = NDArray[np.float64]

WAVES: Final = (2, 3)
"""Changes with direction that are told, in a turn. What is the same from all sides or changes once
in a turn is how a point beside the joint looks, and for that body fitting has offsets; finer ones
would have sides differ within a sixth of a turn."""
TERMS: Final = 2 * len(WAVES)
EXPECTED: Final = 0.02
"""Standard deviation of each coefficient before anything is seen [m]: a hundredth of a body."""


@dataclass(frozen=True, eq=False)
class ViewBias:
    """Errors of keypoints by direction.

    Attributes:
        coefficient: (17, 2, 4) [m], of each joint along the axes of the picture: cosines, then
            sines, of the multiples of the azimuth in `WAVES`.
    """

    coefficient: Floats

    @classmethod
    def none(cls) -> ViewBias:
        """That of a detector which errs the same way from all sides."""
        return cls(np.zeros((17, 2, TERMS)))

    def shift(self, azimuth: NDArray[np.floating], scale: NDArray[np.floating]) -> Floats:
        """Return by how far keypoints (..., 17, 2) are beside their joints [px].

        Args:
            azimuth: (...) of the camera seen from the body [rad]; NaN = unknown.
            scale: (...) [px/m].
        """
        waves = _waves(azimuth) * np.asarray(scale)[..., None]
        return np.asarray(np.einsum("...w,jaw->...ja", waves, self.coefficient))


def find_azimuths(cameras: Camera, joints: Floats) -> Floats:
    """Return from where each camera sees bodies (frames, cameras, persons) [rad].

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
    """Return the bias that goes with the direction of the view, by linear least squares.

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
