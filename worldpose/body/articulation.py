"""Forward kinematics: joint positions from joint rotations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Articulation:
    """Posed frames of the joints, before the body's translation.

    A point `x` fixed to joint j of the unposed body goes to `rotations[j] x + offsets[j]`.
    """

    local_rotations: NDArray[np.float64]
    """(..., joints, 3, 3), relative to the parent."""
    rotations: NDArray[np.float64]
    """(..., joints, 3, 3), relative to the world."""
    joints: NDArray[np.float64]
    """(..., joints, 3) [m]."""
    offsets: NDArray[np.float64]
    """(..., joints, 3) [m]."""

    @property
    def pose_feature(self) -> NDArray[np.float64]:
        """Rotations of all joints but the first minus the identity (..., 9 (joints - 1))."""
        away = self.local_rotations[..., 1:, :, :] - np.eye(3)
        return away.reshape(*away.shape[:-3], 9 * away.shape[-3])


def articulate(
    rest: NDArray[np.float64], local_rotations: NDArray[np.float64], parents: NDArray[np.int64]
) -> Articulation:
    """Return the frames of the joints of a kinematic tree.

    Args:
        rest: (..., joints, 3) [m], joints of the unposed body.
        local_rotations: (..., joints, 3, 3), of each joint relative to its parent.
        parents: (joints,), each smaller than its joint, -1 for the root, which stays in place.
    """
    rotations, joints = local_rotations.copy(), rest.copy()
    for joint, parent in enumerate(parents[1:], start=1):
        bone = (rest[..., joint, :] - rest[..., parent, :])[..., None]
        turning = rotations[..., parent, :, :]
        rotations[..., joint, :, :] = turning @ local_rotations[..., joint, :, :]
        joints[..., joint, :] = joints[..., parent, :] + (turning @ bone)[..., 0]
    offsets = joints - (rotations @ rest[..., None])[..., 0]
    return Articulation(local_rotations, rotations, joints, offsets)
