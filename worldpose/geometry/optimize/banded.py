"""Block-banded Cholesky solver: blocks couple each frame with the next two.

A second difference ties three frames, so the normal equations of a whole track have five diagonals
of blocks. Their Cholesky factor has the same lower blocks and takes time proportional to the number
of frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """Cholesky factor of a block-banded matrix."""

    lower: Floats
    """(3, frames, n, n): blocks of frame t in rows t, t + 1 and t + 2; those past the end are 0."""
    determined: bool
    """Whether the matrix was positive definite; the factor is invalid otherwise."""

    @classmethod
    def of(cls, blocks: Floats) -> BandedFactor:
        """Return the factor of the matrix with these lower blocks.

        Args:
            blocks: (3, frames, n, n); `blocks[k, t]` stands in block row t + k, column t.
        """
        lower = np.ascontiguousarray(blocks).copy()
        return cls(lower, _factorize(lower))

    def solve(self, right: Floats) -> Floats:
        """Return the solutions (frames, n, columns) for right sides (frames, n, columns)."""
        solution = np.ascontiguousarray(right).copy()
        _substitute(self.lower, solution)
        return solution

    def inverse_blocks(self) -> Floats:
        """Return the diagonal blocks (frames, n, n) of the inverse: each frame's covariance.

        Takahashi's recursion from the last frame needs only the band of the inverse.
        """
        frames, size = self.lower.shape[1:3]
        inverse = np.zeros((3, frames + 2, size, size))
        for t in range(frames - 1, -1, -1):
            own = np.linalg.inv(self.lower[0, t])
            below = [self.lower[k, t] @ own for k in (1, 2)]
            # Inverse blocks (t + 1, t), (t + 2, t) from those of later frames.
            a, b, c = inverse[0, t + 1], inverse[1, t + 1], inverse[0, t + 2]
            inverse[1, t] = -(a @ below[0] + b.T @ below[1])
            inverse[2, t] = -(b @ below[0] + c @ below[1])
            corner = own.T @ own - below[0].T @ inverse[1, t] - below[1].T @ inverse[2, t]
            inverse[0, t] = 0.5 * (corner + corner.T)
        return inverse[0, :frames]


@compile_kernel
def _factorize(lower: Floats) -> bool:
    """Factorise in place, left to right; False when the matrix is not positive definite."""
    frames, size = lower.shape[1], lower.shape[2]
    for t in range(frames):
        for back in (1, 2):
            if t >= back:
                first = lower[back, t - back]
                _subtract(lower[0, t], first, first, True)
        if t >= 1 and t + 1 < frames:
            _subtract(lower[1, t], lower[2, t - 1], lower[1, t - 1], False)
        block = lower[0, t]
        for j in range(size):
            pivot = block[j, j]
            for k in range(j):
                pivot -= block[j, k] * block[j, k]
            if not pivot > 0.0:
                return False
            block[j, j] = math.sqrt(pivot)
            for i in range(j + 1, size):
                value = block[i, j]
                for k in range(j):
                    value -= block[i, k] * block[j, k]
                block[i, j] = value / block[j, j]
            for k in range(j + 1, size):
                block[j, k] = 0.0
        for ahead in (1, 2):
            if t + ahead < frames:
                _divide(lower[ahead, t], block)
            else:
                lower[ahead, t] = 0.0
    return True


@compile_kernel
def _subtract(target: Floats, first: Floats, second: Floats, below: bool) -> None:
    """Subtract `first second^T`; only the lower triangle where `below`."""
    size = len(target)
    turned = np.ascontiguousarray(second.T)
    for i in range(size):
        end = i + 1 if below else size
        for k in range(size):
            factor = first[i, k]
            for j in range(end):
                target[i, j] -= factor * turned[k, j]


@compile_kernel
def _divide(target: Floats, block: Floats) -> None:
    """Multiply from the right with the inverse transpose of a lower triangle."""
    size = len(target)
    turned = np.ascontiguousarray(target.T)
    for j in range(size):
        for k in range(j):
            factor = block[j, k]
            for i in range(size):
                turned[j, i] -= factor * turned[k, i]
        factor = 1.0 / block[j, j]
        for i in range(size):
            turned[j, i] *= factor
    for i in range(size):
        for j in range(size):
            target[i, j] = turned[j, i]


@compile_kernel
def _substitute(lower: Floats, right: Floats) -> None:
    """Substitute forward and backward in place."""
    frames, size = lower.shape[1], lower.shape[2]
    columns = right.shape[2]
    for t in range(frames):
        for back in (1, 2):
            if t >= back:
                block = lower[back, t - back]
                for i in range(size):
                    for k in range(size):
                        factor = block[i, k]
                        for c in range(columns):
                            right[t, i, c] -= factor * right[t - back, k, c]
        block = lower[0, t]
        for i in range(size):
            for k in range(i):
                factor = block[i, k]
                for c in range(columns):
                    right[t, i, c] -= factor * right[t, k, c]
            factor = 1.0 / block[i, i]
            for c in range(columns):
                right[t, i, c] *= factor
    for t in range(frames - 1, -1, -1):
        for ahead in (1, 2):
            if t + ahead < frames:
                block = lower[ahead, t]
                for i in range(size):
                    for k in range(size):
                        factor = block[i, k]
                        for c in range(columns):
                            right[t, k, c] -= factor * right[t + ahead, i, c]
        block = lower[0, t]
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                factor = block[k, i]
                for c in range(columns):
                    right[t, i, c] -= factor * right[t, k, c]
            factor = 1.0 / block[i, i]
            for c in range(columns):
                right[t, i, c] *= factor
