"""Least-squares alignment of point sets by a similarity or a rigid motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from worldpose.geometry.rigid import check_shape


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform `x_b = scale R x_a + t`, single or a batch."""

    scale: NDArray[np.float64]
    """(...)"""
    rotation: NDArray[np.float64]
    """(..., 3, 3)"""
    translation: NDArray[np.float64]
    """(..., 3) [m]"""

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return points in frame b.

        Args:
            points: (..., n, 3) [m] in frame a; the batch broadcasts against the dimensions
                before n.
        """
        source = check_shape("Similarity.apply: points", points, (-1, 3))
        scaled = self.scale[..., None, None] * np.swapaxes(self.rotation, -1, -2)
        moved: NDArray[np.float64] = source @ scaled + self.translation[..., None, :]
        return moved


def align(source: ArrayLike, target: ArrayLike, *, with_scale: bool) -> Similarity:
    """Return the motion of `source` with the least sum of squared distances to `target`.

    The function ignores points that are missing on either side. The rotation is always proper: a
    mirrored set stays mirrored. If the motion is not unique, the result is one of the minima:
    collinear points leave the rotation about their line open, and coinciding points give a
    translation (identity, scale 1). Without a common point the motion is NaN.

    Args:
        source: (..., n, 3) [m]; NaN where missing.
        target: (..., n, 3) [m]; NaN where missing.
        with_scale: a similarity (Procrustes analysis) if true, a rigid motion if not.

    Raises:
        InputError: the last dimensions are not (n, 3).

    Note:
        Umeyama, IEEE PAMI 13(4), 1991; E1.
    """
    a, b = np.broadcast_arrays(
        check_shape("align: source", source, (-1, 3)), check_shape("align: target", target, (-1, 3))
    )
    common = np.isfinite(a).all(-1) & np.isfinite(b).all(-1)
    count = common.sum(-1)
    a_mean, a_offset = _center(a, common, count)
    b_mean, b_offset = _center(b, common, count)
    u, s, v = np.linalg.svd(np.swapaxes(b_offset, -1, -2) @ a_offset)
    handed = np.ones_like(s)
    handed[..., 2] = np.where(np.linalg.det(u) * np.linalg.det(v) < 0.0, -1.0, 1.0)
    rotation = (u * handed[..., None, :]) @ v
    spread = np.square(a_offset).sum((-1, -2))
    # Offsets of coinciding points are only rounding errors of their mean.
    single = spread <= count * np.square(8.0 * np.finfo(float).eps * np.abs(a_mean).max(-1))
    rotation = np.where(single[..., None, None], np.eye(3), rotation)
    scale = np.ones(spread.shape)
    if with_scale:
        np.divide((handed * s).sum(-1), spread, out=scale, where=~single)
    scale = np.where(count > 0, scale, np.nan)
    moved = scale[..., None] * (rotation @ a_mean[..., None])[..., 0]
    return Similarity(scale=scale, rotation=rotation, translation=b_mean - moved)


def _center(
    points: NDArray[np.float64], common: NDArray[np.bool_], count: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of the common points and their offsets from it; 0 for other points."""
    known = np.where(common[..., None], points, 0.0)
    mean = known.sum(-2) / np.maximum(count, 1)[..., None]
    return mean, np.where(common[..., None], known - mean[..., None, :], 0.0)
