"""Rigid transforms between two frames, single or in batches, and alignment of point sets."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from types import EllipsisType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Flags, Floats
from worldpose.errors import InputError

Index: TypeAlias = (
    int
    | slice
    | EllipsisType
    | NDArray[np.integer]
    | Flags
    | tuple[int | slice | EllipsisType | NDArray[np.integer] | Flags | None, ...]
)
"""Index types of numpy; an index addresses the batch dimensions only."""


def unit(vectors: NDArray[Any]) -> NDArray[Any]:
    """Return vectors (..., n) of length 1 in the same direction."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-9))


def cross(first: Floats, second: Floats) -> Floats:
    """Return the cross products (..., 3); for few vectors `np.cross` takes far longer."""
    after, before = (1, 2, 0), (2, 0, 1)
    product: Floats = first[..., after] * second[..., before]
    product -= first[..., before] * second[..., after]
    return product


def orthonormal_frame(first: Floats, second: Floats) -> Floats:
    """Return orthonormal columns (..., 3, 3): along the first, then towards the second."""
    along = unit(first)
    third = unit(cross(along, second))
    return np.stack([along, cross(third, along), third], axis=-1)


@dataclass(frozen=True, eq=False)
class Rigid:
    """The transform `x_b = rotation x_a + translation`, named `b_from_a`.

    Transforms compose as algebra: `c_from_b @ b_from_a` is `c_from_a`. Batch dimensions broadcast
    against each other, in the constructor and in every operation.

    Raises:
        InputError: an array has the wrong trailing shape or the batches do not broadcast.
    """

    rotation: Floats
    """(..., 3, 3), orthonormal with determinant 1."""
    translation: Floats
    """(..., 3) [m]."""

    def __post_init__(self) -> None:
        rotation = check_shape("Rigid.rotation", self.rotation, (3, 3))
        translation = check_shape("Rigid.translation", self.translation, (3,))
        batch = common_batch("Rigid", rotation.shape[:-2], translation.shape[:-1])
        object.__setattr__(self, "rotation", np.broadcast_to(rotation, (*batch, 3, 3)))
        object.__setattr__(self, "translation", np.broadcast_to(translation, (*batch, 3)))

    @classmethod
    def identity(cls) -> Rigid:
        """Return the identity transform."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_rotvec(cls, rotvec: ArrayLike, translation: ArrayLike) -> Rigid:
        """Return the transform with an axis-angle rotation (Rodrigues' formula).

        Args:
            rotvec: (..., 3) [rad], the axis times the angle.
            translation: (..., 3) [m].
        """
        vector = check_shape("Rigid.from_rotvec: rotvec", rotvec, (3,))
        angle = np.linalg.norm(vector, axis=-1)[..., None, None]
        # np.sinc keeps sin(a) / a and (1 - cos(a)) / a^2 exact at and near zero.
        rotation = (
            np.cos(angle) * np.eye(3)
            + np.sinc(angle / np.pi) * _cross_matrix(vector)
            + 0.5
            * np.sinc(angle / (2.0 * np.pi)) ** 2
            * vector[..., :, None]
            * vector[..., None, :]
        )
        return cls(rotation, np.asarray(translation, dtype=np.float64))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch; () for a single transform."""
        return self.translation.shape[:-1]

    @property
    def rotvec(self) -> Floats:
        """Axis-angle vectors of the rotation (..., 3) [rad] with angles in [0, pi]."""
        r = self.rotation
        diagonal = np.diagonal(r, axis1=-2, axis2=-1)
        trace = diagonal.sum(-1)
        # Four times the outer product of the unit quaternion (w, x, y, z) with itself. Its row
        # with the largest diagonal entry is the quaternion up to a scale that is never small.
        outer = np.empty((*self.batch_shape, 4, 4))
        outer[..., 0, 0] = 1.0 + trace
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            outer[..., i + 1, i + 1] = 1.0 + 2.0 * diagonal[..., i] - trace
            outer[..., 0, i + 1] = outer[..., i + 1, 0] = r[..., k, j] - r[..., j, k]
            outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = r[..., k, j] + r[..., j, k]
        largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
        quaternion = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
        quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
        quaternion = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
        sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            factor = np.where(sine == 0.0, 2.0, 2.0 * np.arctan2(sine, quaternion[..., :1]) / sine)
        scaled: Floats = factor * quaternion[..., 1:]
        return scaled

    def inverse(self) -> Rigid:
        """Return `a_from_b`."""
        transposed = np.swapaxes(self.rotation, -1, -2)
        return Rigid(transposed, -np.einsum("...ij,...j->...i", transposed, self.translation))

    def __matmul__(self, other: Rigid) -> Rigid:
        return Rigid(
            self.rotation @ other.rotation,
            np.einsum("...ij,...j->...i", self.rotation, other.translation) + self.translation,
        )

    def apply(self, points: ArrayLike) -> Floats:
        """Return points in frame b.

        Args:
            points: (..., n, 3) [m] in frame a; the batch of the transform broadcasts against the
                dimensions before n.

        Raises:
            InputError: the last dimension is not 3 or there is no n.
        """
        points_a = check_shape("Rigid.apply: points", points, (-1, 3))
        moved: Floats = (
            points_a @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]
        )
        return moved

    def retract(self, delta: ArrayLike) -> Rigid:
        """Return the transform after a small motion in frame b, the tangent update of solvers.

        The motion acts from the left, rotation first: `x_b' = exp(delta[:3]) x_b + delta[3:]`,
        so the derivative of x_b' at delta = 0 is `[-cross(x_b), identity]`.

        Args:
            delta: (..., 6): rotation vector [rad], then translation [m], both in frame b.

        Raises:
            InputError: the last dimension is not 6.
        """
        motion = check_shape("Rigid.retract: delta", delta, (6,))
        return Rigid.from_rotvec(motion[..., :3], motion[..., 3:]) @ self

    def __getitem__(self, index: Index) -> Rigid:
        return Rigid(
            self.rotation[index_leading(index, 2)], self.translation[index_leading(index, 1)]
        )


def nearest_rotation(where: str, matrix: ArrayLike) -> Floats:
    """Return the exact rotation nearest to a matrix given with at least six decimals.

    Args:
        where: file and position of the matrix, for the message.
        matrix: (3, 3), R of x_b = R x_a + t.

    Raises:
        InputError: the matrix is not orthonormal with determinant 1 within six decimals.
    """
    rotation = check_shape(where, matrix, (3, 3))
    excess = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    determinant = float(np.dot(rotation[0], np.cross(rotation[1], rotation[2])))
    # Six decimals, truncated, put at most 2 sqrt(3) 1e-6 into rotation^T rotation.
    if not excess <= 4e-6 or determinant < 0.0:
        raise InputError(
            where,
            expected="an orthonormal matrix with determinant 1",
            found=f"determinant {determinant:.6g}, largest entry {excess:.3g} of R^T R - identity",
            todo="Give R of x_b = R x_a + t with at least six decimals, without mirrored axes.",
        )
    # Rotations with all digits of float64 read back within this error.
    if excess <= 1e-14:
        return rotation
    u, _, v = np.linalg.svd(rotation)
    nearest: Floats = u @ v
    return nearest


def index_leading(index: Index, trailing: int) -> tuple[Any, ...]:
    """Return `index` extended so that it cannot reach the last `trailing` dimensions."""
    return (*(index if isinstance(index, tuple) else (index,)), *(slice(None),) * trailing)


def check_shape(where: str, array: ArrayLike, trailing: tuple[int, ...]) -> Floats:
    """Return `array` as float64 after a check of its last dimensions; -1 stands for any length.

    Raises:
        InputError: the last dimensions differ from `trailing`.
    """
    values = np.asarray(array, dtype=np.float64)
    last = values.shape[values.ndim - len(trailing) :] if values.ndim >= len(trailing) else None
    if last is None or any(want not in (-1, got) for want, got in zip(trailing, last, strict=True)):
        wanted = ", ".join("n" if want == -1 else str(want) for want in trailing)
        raise InputError(
            where,
            expected=f"shape (..., {wanted})",
            found=f"shape {values.shape}",
            todo="Check the order of the dimensions.",
        )
    return values


def common_batch(where: str, *batches: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape that all batch shapes broadcast to.

    Raises:
        InputError: the shapes do not broadcast.
    """
    try:
        return functools.reduce(np.broadcast_shapes, batches)
    except ValueError:
        raise InputError(
            where,
            expected="batch shapes that broadcast",
            found=" and ".join(str(batch) for batch in batches),
            todo="Give every part the same batch dimensions, or none.",
        ) from None


def _cross_matrix(vector: Floats) -> Floats:
    """Return (..., 3, 3) matrices M with M x = vector cross x."""
    matrix = np.zeros((*vector.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., k, j] = vector[..., i]
        matrix[..., j, k] = -vector[..., i]
    return matrix


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform `x_b = scale R x_a + t`, single or a batch."""

    scale: Floats
    """(...)"""
    rotation: Floats
    """(..., 3, 3)"""
    translation: Floats
    """(..., 3) [m]"""

    def apply(self, points: ArrayLike) -> Floats:
        """Return points in frame b.

        Args:
            points: (..., n, 3) [m] in frame a; the batch broadcasts against the dimensions
                before n.
        """
        source = check_shape("Similarity.apply: points", points, (-1, 3))
        scaled = self.scale[..., None, None] * np.swapaxes(self.rotation, -1, -2)
        moved: Floats = source @ scaled + self.translation[..., None, :]
        return moved


def shortest_rotation(start: Floats, end: Floats) -> Floats:
    """Return the smallest rotations (..., 3, 3) of unit vectors (..., 3) to others."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (start * end).sum(axis=-1, keepdims=True))
    return Rigid.from_rotvec(axis / np.maximum(sine, 1e-12) * angle, np.zeros(3)).rotation


def align(
    source: ArrayLike, target: ArrayLike, *, with_scale: bool, weights: ArrayLike = 1.0
) -> Similarity:
    """Return the motion of `source` with the least weighted sum of squared distances to `target`.

    The function ignores points that are missing on either side. The rotation is always proper: a
    mirrored set stays mirrored. If the motion is not unique, the result is one of the minima:
    collinear points leave the rotation about their line open, and coinciding points give a
    translation (identity, scale 1). Without a common point the motion is NaN.

    Args:
        source: (..., n, 3) [m]; NaN where missing.
        target: (..., n, 3) [m]; NaN where missing.
        with_scale: a similarity (Procrustes analysis) if true, a rigid motion if not.
        weights: (..., n) weight of each pair.

    Raises:
        InputError: the last dimensions are not (n, 3).

    Note:
        Umeyama, IEEE PAMI 13(4), 1991.
    """
    a, b = np.broadcast_arrays(
        check_shape("align: source", source, (-1, 3)), check_shape("align: target", target, (-1, 3))
    )
    common = np.isfinite(a).all(-1) & np.isfinite(b).all(-1)
    weight = np.where(common, weights, 0.0)
    a_mean, a_offset = _center(a, weight)
    b_mean, b_offset = _center(b, weight)
    u, s, v = np.linalg.svd(np.swapaxes(weight[..., None] * b_offset, -1, -2) @ a_offset)
    handed = np.ones_like(s)
    handed[..., 2] = np.where(np.linalg.det(u) * np.linalg.det(v) < 0.0, -1.0, 1.0)
    rotation = (u * handed[..., None, :]) @ v
    spread = (weight * np.square(a_offset).sum(-1)).sum(-1)
    # Offsets of coinciding points are only rounding errors of their mean.
    single = spread <= weight.sum(-1) * np.square(
        8.0 * np.finfo(float).eps * np.abs(a_mean).max(-1)
    )
    rotation = np.where(single[..., None, None], np.eye(3), rotation)
    scale = np.ones(spread.shape)
    if with_scale:
        np.divide((handed * s).sum(-1), spread, out=scale, where=~single)
    scale = np.where(common.any(-1), scale, np.nan)
    moved = scale[..., None] * (rotation @ a_mean[..., None])[..., 0]
    return Similarity(scale=scale, rotation=rotation, translation=b_mean - moved)


def _center(points: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the weighted mean of points and their offsets from it; 0 without weight."""
    known = weight[..., None] > 0.0
    total = weight.sum(-1)
    weighted = np.where(known, weight[..., None] * points, 0.0).sum(-2)
    mean = weighted / np.where(total > 0.0, total, 1.0)[..., None]
    return mean, np.where(known, points - mean[..., None, :], 0.0)
