"""Arrow matrices: a band of blocks, one per frame, and a border of parameters shared by all frames.

With the band B, the border E and the corner C, the shared parameters solve the Schur complement
C - E^T B^-1 E, and the frames follow by substitution. The time grows linearly with the frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry.optimize.banded import BandedFactor


class ArrowSystem(NamedTuple):
    """Normal equations, which the terms of a cost are added to."""

    blocks: Floats
    """(3, frames, n, n) band, see `BandedFactor`."""
    border: Floats
    """(frames, n, shared)"""
    corner: Floats
    """(shared, shared)"""
    right: Floats
    """(frames, n) gradient by the frames' parameters."""
    right_corner: Floats
    """(shared,) gradient by the shared parameters."""

    @classmethod
    def zeros(cls, frames: int, size: int, shared: int) -> ArrowSystem:
        """Return a system without any term."""
        return cls(
            blocks=np.zeros((3, frames, size, size)),
            border=np.zeros((frames, size, shared)),
            corner=np.zeros((shared, shared)),
            right=np.zeros((frames, size)),
            right_corner=np.zeros(shared),
        )


@dataclass(frozen=True, eq=False)
class ArrowFactor:
    """Factor of an arrow matrix.

    Attributes:
        border: (frames, n, shared)
        answer: (frames, n, shared) B^-1 E.
        reduced: (shared, shared) Schur complement.
    """

    band: BandedFactor
    border: Floats
    answer: Floats
    reduced: Floats

    @classmethod
    def of(cls, system: ArrowSystem, damping: float = 0.0) -> ArrowFactor:
        """Return the factor with the diagonal times 1 + damping, invalid unless `determined`."""
        blocks, n = system.blocks.copy(), system.right.shape[1]
        blocks[0][:, range(n), range(n)] *= 1.0 + damping
        band = BandedFactor.of(blocks, overwrite=True)
        shared = len(system.corner)
        answer = band.solve(system.border)
        product = system.border.reshape(-1, shared).T @ answer.reshape(-1, shared)
        corner = system.corner * (1.0 + damping * np.eye(shared))
        return cls(band, system.border, answer, corner - product)

    @property
    def determined(self) -> bool:
        """Whether the band is positive definite."""
        return self.band.determined

    def solve(self, right: Floats, right_corner: Floats) -> tuple[Floats, Floats]:
        """Return the solutions (frames, n, k) and (shared, k) for right sides of these shapes."""
        own = self.band.solve(right)
        flat = self.border.reshape(-1, self.border.shape[2])
        shared = np.linalg.solve(self.reduced, right_corner - flat.T @ own.reshape(len(flat), -1))
        return own - self.answer @ shared, np.asarray(shared)

    def shared_covariance(self) -> Floats:
        """Return the covariance (shared, shared) of the shared parameters."""
        return np.asarray(np.linalg.inv(0.5 * (self.reduced + self.reduced.T)))

    def frame_covariance(self, shared: Floats) -> Floats:
        """Return covariances (frames, n, n) of frames by that of shared ones (shared, shared)."""
        spread = self.answer @ shared @ np.swapaxes(self.answer, -1, -2)
        return np.asarray(self.band.inverse_blocks() + spread)
