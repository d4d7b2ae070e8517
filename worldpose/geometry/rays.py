"""Half-lines from camera centres through image points: distances and intersection."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Flags, Floats, Image
from worldpose.errors import InputError
from worldpose.geometry.rigid import Index, check_shape, common_batch, index_leading


class RayStatus(IntEnum):
    """Reason for a point without image, or an image point without ray."""

    OK = 0
    MISSING = 1
    """The input, or a parameter of the camera, is not finite."""
    BEHIND = 2
    """The point is at or behind the plane of the camera centre."""
    BEYOND_FOLD = 3
    """The lens model is not one to one there: a point has no meaningful image, a pixel no ray."""
    NOT_CONVERGED = 4
    """The inverse of the lens model did not converge."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Half-lines in the world frame.

    Raises:
        InputError: the shapes do not agree.
    """

    origins: Floats
    """(..., 3) camera centres [m], world."""
    directions: Floats
    """(..., 3) unit vectors, world; NaN where `status` is not OK."""
    status: Image
    """(...) RayStatus."""

    def __post_init__(self) -> None:
        directions = check_shape("Rays.directions", self.directions, (3,))
        origins = check_shape("Rays.origins", self.origins, (3,))
        status = np.asarray(self.status, dtype=np.uint8)
        batch = common_batch("Rays", directions.shape[:-1], origins.shape[:-1], status.shape)
        object.__setattr__(self, "origins", np.broadcast_to(origins, (*batch, 3)))
        object.__setattr__(self, "directions", np.broadcast_to(directions, (*batch, 3)))
        object.__setattr__(self, "status", np.broadcast_to(status, batch))

    @property
    def valid(self) -> Flags:
        """(...) whether the ray exists."""
        return np.asarray(self.status == RayStatus.OK)

    def __getitem__(self, index: Index) -> Rays:
        return Rays(
            self.origins[index_leading(index, 1)],
            self.directions[index_leading(index, 1)],
            self.status[index_leading(index, 0)],
        )


def intersect_rays(rays: Rays, weights: ArrayLike | None = None) -> tuple[Floats, Floats]:
    """Return the points nearest to each bundle of rays in the weighted least-squares sense.

    The point p minimises the sum of weight * squared distance to the lines of the rays (..., m).
    Missing rays are left out, as are those whose weight (..., m) is 0 or NaN; None weighs all
    alike. InputError if one is negative.

    Returned are points (..., 3) [m], world, and normal matrices (..., 3, 3), the sums of weight *
    (identity - d d^T). With weights 1 / sigma^2 [1/m^2] the inverse of a normal matrix is the
    covariance of its point. Points are NaN where fewer than two rays remain or all remaining rays
    are parallel, to about 2e-6 rad: rounding then moves the point by over a millimetre at 100 m.
    """
    weight = np.ones(rays.status.shape) if weights is None else np.asarray(weights, dtype=float)
    if np.any(weight < 0.0):
        raise InputError(
            "intersect_rays: weights",
            expected="no negative weight",
            found=f"{np.nanmin(weight):g}",
            todo="Give 1 / sigma^2, or 0 to leave a ray out.",
        )
    used = rays.valid & (weight > 0.0)
    weight = np.where(used, weight, 0.0)
    directions = np.where(used[..., None], rays.directions, 0.0)
    origins = np.where(used[..., None], rays.origins, 0.0)
    total = weight.sum(-1)
    with np.errstate(invalid="ignore"):
        # Coordinates about the mean origin keep the digits that the world's origin would cost.
        mean = (weight[..., None] * origins).sum(-2) / total[..., None]
    offset = np.where(used[..., None], origins - mean[..., None, :], 0.0)
    normal = total[..., None, None] * np.eye(3) - np.einsum(
        "...m,...mi,...mj->...ij", weight, directions, directions
    )
    along = np.einsum("...mi,...mi->...m", offset, directions)
    right = np.einsum("...m,...mi->...i", weight, offset - along[..., None] * directions)
    with np.errstate(invalid="ignore"):
        # The eigenvalues of normal / total sum to 2 and none exceeds 1, so the determinant is
        # the smallest eigenvalue up to a factor of 3: sin^2(angle / 2) for two equal rays.
        # One ray or none leaves it zero or NaN.
        solvable = np.linalg.det(normal / total[..., None, None]) > 1e-12
    safe = np.where(solvable[..., None, None], normal, np.eye(3))
    points = np.linalg.solve(safe, right[..., None])[..., 0] + mean
    return np.where(solvable[..., None], points, np.nan), normal
