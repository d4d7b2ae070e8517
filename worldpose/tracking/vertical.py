"""The axis along which people stand, from their joints in any world frame and unit."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from data_contracts.arrays import Floats

ALIGNED: Final = float(np.cos(np.radians(30.0)))
"""Cosine from which a person stands along an axis [1]: people who run lean by 15 degrees."""
SAME_AXIS: Final = float(np.cos(np.radians(2.5)))
"""Cosine from which people's axis is one of the world's [1]; people tell it within 1 degree."""


class Vertical(NamedTuple):
    """Unit vector (3,) from feet to head, and the share of the poses that stand along it [1]."""

    axis: Floats
    share: float
    poses: int

    @property
    def is_clear(self) -> bool:
        """Whether most people stand, and along one axis."""
        return self.poses >= 4 and self.share >= 0.6

    @property
    def is_z(self) -> bool:
        """Whether they stand along z."""
        return bool(self.axis[2] >= ALIGNED)

    def describe(self, up: str = "z") -> str:
        """Return a sentence part that contradicts a world with another axis up."""
        return (
            f"the upright axis of people is {name_axis(self.axis)}, not {up}: {self.share:.0%} of "
            f"{self.poses} poses stand along it"
        )


def find_vertical(joints: Floats) -> Vertical | None:
    """Return the axis along which people (..., 17, 3), in any unit, stand; None if unknown."""
    joints = joints.reshape(-1, 17, 3).astype(np.float64)
    shoulders, hips, ankles = (joints[:, [n, n + 1]].mean(axis=1) for n in (5, 11, 15))
    parts = np.stack([shoulders - hips, hips - ankles])
    with np.errstate(invalid="ignore", divide="ignore"):
        parts /= np.linalg.norm(parts, axis=-1, keepdims=True)
        # Without ankles, the trunk alone.
        lean = np.where(np.isfinite(parts[1]), parts.sum(axis=0), parts[0])
        lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    lean = lean[np.isfinite(lean).all(axis=1)]
    if not len(lean):
        return None
    axis = np.median(lean, axis=0)
    for _ in range(3):
        axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
        near = lean @ axis >= ALIGNED
        axis = lean[near].mean(axis=0) if near.any() else axis
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    return Vertical(axis, float((lean @ axis >= ALIGNED).mean()), len(lean))


def name_axis(axis: Floats) -> str:
    """Return an axis as `--up` takes it: y, or -y, or three numbers."""
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) >= SAME_AXIS:
        return ("-" if axis[largest] < 0.0 else "") + "xyz"[largest]
    return ",".join(f"{value:.3f}" for value in axis)


def snap_to_axis(up: Floats) -> Floats:
    """Return the world's own axis near a unit vector (3,): it is more accurate than people."""
    largest = int(np.abs(up).argmax())
    exact = np.sign(up[largest]) * np.eye(3)[largest]
    return np.asarray(exact if up @ exact >= SAME_AXIS else up)


def describe_turn(up: Floats) -> str:
    """Return the axis that is turned to z, with the rotation."""
    turn = Rotation.from_matrix(turn_to_z(up)).as_rotvec()
    angle = float(np.linalg.norm(turn))
    return f"{name_axis(up)}, turned by {np.degrees(angle):.1f} degrees about " + (
        name_axis(turn / angle) if angle > 0.0 else "z"
    )


def turn_to_z(up: Floats) -> Floats:
    """Return the smallest rotation (3, 3) that brings a unit vector to z; about x if it is -z."""
    if up[2] < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = up
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + z))
