"""Body parameters: shape, orientation, joint angles and position, named as in the release (X3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry.rigid import Index, checked, common_batch, leading

BODY_POSE = 69
"""Length of `body_pose`: three angles for each of the 23 joints below the pelvis."""


@dataclass(frozen=True, eq=False)
class BodyParameters:
    """One body or a batch of them; batch dimensions broadcast against each other.

    Rotations are axis-angle vectors relative to the parent joint. `global_orient` rotates the body
    about its pelvis joint, and `transl` is added after that: the pelvis of a body stands at
    `transl` plus the pelvis of its unposed shape. The model itself stands upright along +y, so in a
    world with z up a standing body has a `global_orient` near (pi / 2, 0, 0).

    Raises:
        InputError: an array has the wrong trailing shape or the batches do not broadcast.
    """

    betas: NDArray[np.float64]
    """(..., shapes), comparable only within one body model."""
    global_orient: NDArray[np.float64]
    """(..., 3) [rad], world."""
    body_pose: NDArray[np.float64]
    """(..., 69) [rad]."""
    transl: NDArray[np.float64]
    """(..., 3) [m], world."""

    def __post_init__(self) -> None:
        lengths = {"betas": -1, "global_orient": 3, "body_pose": BODY_POSE, "transl": 3}
        arrays = {
            name: checked(f"BodyParameters.{name}", getattr(self, name), (length,))
            for name, length in lengths.items()
        }
        batch = common_batch("BodyParameters", *(array.shape[:-1] for array in arrays.values()))
        for name, array in arrays.items():
            object.__setattr__(self, name, np.broadcast_to(array, (*batch, array.shape[-1])))

    @classmethod
    def rest(cls, shapes: int = 10) -> BodyParameters:
        """Return the mean body in T-pose, upright along +y."""
        return cls(np.zeros(shapes), np.zeros(3), np.zeros(BODY_POSE), np.zeros(3))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch; () for a single body."""
        return self.transl.shape[:-1]

    def __getitem__(self, index: Index) -> BodyParameters:
        return BodyParameters(*(array[leading(index, 1)] for array in self._arrays()))

    def flat(self) -> BodyParameters:
        """Return the same bodies in one batch dimension."""
        return BodyParameters(*(array.reshape(-1, array.shape[-1]) for array in self._arrays()))

    def _arrays(self) -> tuple[NDArray[np.float64], ...]:
        return self.betas, self.global_orient, self.body_pose, self.transl
