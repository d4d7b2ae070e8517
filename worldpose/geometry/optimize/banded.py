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
    def of(cls, blocks: Floats, *, overwrite: bool = False) -> BandedFactor:
        """Return the factor of the matrix with these lower blocks, whose memory it may overwrite.

        Of blocks (3, frames, n, n), `blocks[k, t]` stands in block row t + k, column t.
        """
        lower = np.ascontiguousarray(blocks)
        if lower is blocks and not overwrite:
            lower = lower.copy()
        return cls(lower, _factorize(lower))

    def solve(self, right: Floats) -> Floats:
        """Return the solutions (frames, n, columns) for right sides (frames, n, columns)."""
        solution = np.ascontiguousarray(right).copy()
        if solution.shape[-1] == 1:
            _substitute_vector(self.lower, solution[..., 0])
        else:
            _substitute(self.lower, solution)
        return solution

    def inverse_blocks(self) -> Floats:
        """Return the diagonal blocks (frames, n, n) of the inverse: each frame's covariance.

        Takahashi's recursion from the last frame needs only the band of the inverse.
        """
        return _invert_band(self.lower)


@compile_kernel
def _factorize(lower: Floats) -> bool:
    """Factorise in place, left to right; False when the matrix is not positive definite."""
    frames, size = lower.shape[1], lower.shape[2]
    turned = np.empty((size, size))
    for t in range(frames):
        for back in (1, 2):
            if t >= back:
                first = lower[back, t - back]
                _subtract(lower[0, t], first, first, True)
        if t >= 1 and t + 1 < frames:
            _subtract(lower[1, t], lower[2, t - 1], lower[1, t - 1], False)
        block = lower[0, t]
        if not factorize_block(block, turned):
            return False
        for ahead in (1, 2):
            if t + ahead < frames:
                _divide(lower[ahead, t], block)
            else:
                lower[ahead, t] = 0.0
    return True


@compile_kernel
def factorize_block(block: Floats, turned: Floats) -> bool:
    """Factorise a block in place, with room `turned`; False when it is not positive definite.

    Four columns at a time, so that the rest is read and written a quarter as often; inner loops run
    along rows of the transposed factor.
    """
    size = len(block)
    for i in range(size):
        for j in range(i + 1):
            turned[j, i] = block[i, j]
    for first in range(0, size, 4):
        end = min(first + 4, size)
        for j in range(first, end):
            row = turned[j]
            for k in range(first, j):
                factor = turned[k, j]
                for i in range(j, size):
                    row[i] -= factor * turned[k, i]
            if not row[j] > 0.0:
                return False
            root = math.sqrt(row[j])
            for i in range(j, size):
                row[i] /= root
        if end < first + 4:
            break  # these were the last columns
        r0, r1, r2, r3 = turned[first], turned[first + 1], turned[first + 2], turned[first + 3]
        for k in range(end, size):
            row = turned[k]
            f0, f1, f2, f3 = r0[k], r1[k], r2[k], r3[k]
            for i in range(k, size):
                row[i] -= (f0 * r0[i] + f1 * r1[i]) + (f2 * r2[i] + f3 * r3[i])
    for i in range(size):
        for j in range(size):
            block[i, j] = turned[j, i] if j <= i else 0.0
    return True


@compile_kernel
def _subtract(target: Floats, first: Floats, second: Floats, below: bool) -> None:
    """Subtract `first second^T`; only the lower triangle where `below`."""
    size = len(target)
    turned = np.ascontiguousarray(second.T)
    whole = size - size % 4
    for i in range(size):
        end = i + 1 if below else size
        for k in range(0, whole, 4):  # four at once read and write the target a quarter as often
            f0, f1, f2, f3 = first[i, k], first[i, k + 1], first[i, k + 2], first[i, k + 3]
            for j in range(end):
                target[i, j] -= (f0 * turned[k, j] + f1 * turned[k + 1, j]) + (
                    f2 * turned[k + 2, j] + f3 * turned[k + 3, j]
                )
        for k in range(whole, size):
            factor = first[i, k]
            for j in range(end):
                target[i, j] -= factor * turned[k, j]


@compile_kernel
def _divide(target: Floats, block: Floats) -> None:
    """Multiply from the right with the inverse transpose of a lower triangle."""
    size = len(target)
    turned = np.ascontiguousarray(target.T)
    for j in range(size):
        whole = j - j % 4
        for k in range(0, whole, 4):
            f0, f1, f2, f3 = block[j, k], block[j, k + 1], block[j, k + 2], block[j, k + 3]
            for i in range(size):
                turned[j, i] -= (f0 * turned[k, i] + f1 * turned[k + 1, i]) + (
                    f2 * turned[k + 2, i] + f3 * turned[k + 3, i]
                )
        for k in range(whole, j):
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
def _invert_band(lower: Floats) -> Floats:
    """Return the diagonal blocks (frames, n, n) of the inverse of a factorised matrix."""
    frames, size = lower.shape[1], lower.shape[2]
    result = np.empty((frames, size, size))
    # Blocks (t + 1, t + 1), (t + 2, t + 1) and (t + 2, t + 2) of the inverse.
    corner, side, second = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    for t in range(frames - 1, -1, -1):
        own = np.eye(size)  # inverse of the factor's diagonal block
        block = lower[0, t]
        for i in range(size):
            for k in range(i):
                factor = block[i, k]
                for j in range(k + 1):
                    own[i, j] -= factor * own[k, j]
            for j in range(i + 1):
                own[i, j] /= block[i, i]
        first_below, second_below = lower[1, t] @ own, lower[2, t] @ own
        first = corner @ first_below + side.T @ second_below
        both = side @ first_below + second @ second_below
        new = own.T @ own + first_below.T @ first + second_below.T @ both
        for i in range(size):
            for j in range(size):
                result[t, i, j] = 0.5 * (new[i, j] + new[j, i])
        corner, side, second = result[t], -first, corner
    return result


@compile_kernel
def _substitute(lower: Floats, right: Floats) -> None:
    """Substitute forward and backward in place."""
    frames, size = lower.shape[1], lower.shape[2]
    turned = np.empty((size, size))
    for t in range(frames):
        for back in (1, 2):
            if t >= back:
                block, known = lower[back, t - back], right[t - back]
                for i in range(size):
                    _subtract_rows(right[t, i], block[i], known, 0, size)
        block = lower[0, t]
        for i in range(size):
            _subtract_rows(right[t, i], block[i], right[t], 0, i)
            right[t, i] *= 1.0 / block[i, i]
    for t in range(frames - 1, -1, -1):
        for ahead in (1, 2):
            if t + ahead < frames:
                turned[:] = lower[ahead, t].T
                for k in range(size):
                    _subtract_rows(right[t, k], turned[k], right[t + ahead], 0, size)
        turned[:] = lower[0, t].T
        for i in range(size - 1, -1, -1):
            _subtract_rows(right[t, i], turned[i], right[t], i + 1, size)
            right[t, i] *= 1.0 / turned[i, i]


@compile_kernel
def _subtract_rows(target: Floats, factors: Floats, rows: Floats, first: int, last: int) -> None:
    """Subtract the sum of some rows (n, columns), each times its factor (n,), four at once."""
    columns = len(target)
    whole = first + (last - first) // 4 * 4
    for k in range(first, whole, 4):
        f0, f1, f2, f3 = factors[k], factors[k + 1], factors[k + 2], factors[k + 3]
        for c in range(columns):
            target[c] -= (f0 * rows[k, c] + f1 * rows[k + 1, c]) + (
                f2 * rows[k + 2, c] + f3 * rows[k + 3, c]
            )
    for k in range(whole, last):
        factor = factors[k]
        for c in range(columns):
            target[c] -= factor * rows[k, c]


@compile_kernel
def _substitute_vector(lower: Floats, right: Floats) -> None:
    """Substitute forward and backward in place in one vector (frames, n)."""
    frames, size = lower.shape[1], lower.shape[2]
    for t in range(frames):
        own, block = right[t], lower[0, t]
        for back in (1, 2):
            if t >= back:
                side, known = lower[back, t - back], right[t - back]
                for i in range(size):
                    own[i] -= _dot(side[i], known, size)
        for i in range(size):
            own[i] = (own[i] - _dot(block[i], own, i)) / block[i, i]
    for t in range(frames - 1, -1, -1):
        own, block = right[t], lower[0, t]
        for ahead in (1, 2):
            if t + ahead < frames:
                side, known = lower[ahead, t], right[t + ahead]
                for i in range(size):
                    factor = known[i]
                    for k in range(size):
                        own[k] -= factor * side[i, k]
        for i in range(size - 1, -1, -1):
            own[i] /= block[i, i]
            factor = own[i]
            for k in range(i):
                own[k] -= factor * block[i, k]


@compile_kernel
def _dot(first: Floats, second: Floats, count: int) -> float:
    """Return the product of the first `count` elements, four sums at a time."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    whole = count - count % 4
    for k in range(0, whole, 4):
        s0 += first[k] * second[k]
        s1 += first[k + 1] * second[k + 1]
        s2 += first[k + 2] * second[k + 2]
        s3 += first[k + 3] * second[k + 3]
    for k in range(whole, count):
        s0 += first[k] * second[k]
    return (s0 + s1) + (s2 + s3)
