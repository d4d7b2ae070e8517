"""Machine code for the equations of points that move with a body's unknowns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.geometry.optimize.banded import factorize_block


@compile_kernel
def invert_symmetric(matrices: Floats) -> Floats:
    """Return the inverses of symmetric matrices (frames, points, 3, 3), much sooner than LAPACK."""
    inverses = np.empty(matrices.shape)
    for t in range(matrices.shape[0]):
        for p in range(matrices.shape[1]):
            m, out = matrices[t, p], inverses[t, p]
            xx = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
            xy = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
            xz = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
            scale = 1.0 / (m[0, 0] * xx + m[0, 1] * xy + m[0, 2] * xz)
            out[0, 0] = scale * xx
            out[1, 1] = scale * (m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2])
            out[2, 2] = scale * (m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1])
            out[0, 1] = out[1, 0] = scale * xy
            out[0, 2] = out[2, 0] = scale * xz
            out[1, 2] = out[2, 1] = scale * (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2])
    return inverses


@compile_kernel
def accumulate_points(
    rows: Floats, own: Floats, next_frame: Floats, second_frame: Floats, force: Floats, tied: bool
) -> tuple[Floats, Floats]:
    """Return the blocks (3, frames, 36, 36) and the gradient (frames, 36) of point terms.

    Blocks on the diagonal are whole in the lower triangle alone, which is all that the factor
    reads. A point moves with few of the angles: products skip those that leave it in place.

    `rows` (frames, points, 3, 36) are derivatives of points, `own` (frames, points, 3, 3) is their
    information, and `force` (frames, points, 3) the derivative of the cost by them. `next_frame`
    and `second_frame` (frames, points) weigh the product with the point in the next frame and the
    one after; unless `tied`, there are only the blocks (1, frames, 36, 36).
    """
    frames, points, _, size = rows.shape
    blocks = np.zeros((3 if tied else 1, frames, size, size))
    gradient = np.zeros((frames, size))
    scaled = np.empty((3, size))
    # In all frames: a derivative may be zero in one of them by chance.
    moving = np.zeros((points, size))
    for t in range(frames):
        for p in range(points):
            for a in range(3):
                for j in range(size):
                    moving[p, j] += abs(rows[t, p, a, j])
    moved, counts = np.empty((points, size), dtype=np.int64), np.empty(points, dtype=np.int64)
    for p in range(points):
        counts[p] = _list_active(moving[p : p + 1], moved[p])
    for t in range(frames):
        slope = gradient[t]
        last = min(t + 2, frames - 1)
        for p in range(points):
            active, count = moved[p], counts[p]
            end = _round_up(active[count - 1] + 1, size)
            r, f = rows[t, p], own[t, p]
            u, v, w = force[t, p]
            for j in range(end):
                x, y, z = r[0, j], r[1, j], r[2, j]
                scaled[0, j] = f[0, 0] * x + f[0, 1] * y + f[0, 2] * z
                scaled[1, j] = f[1, 0] * x + f[1, 1] * y + f[1, 2] * z
                scaled[2, j] = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
                slope[j] += u * x + v * y + w * z
            for place in range(count):
                i = active[place]
                f0, f1, f2 = r[0, i], r[1, i], r[2, i]
                for j in range(_round_up(i + 1, end)):
                    blocks[0, t, i, j] += f0 * scaled[0, j] + f1 * scaled[1, j] + f2 * scaled[2, j]
            ahead = next_frame[t, p] != 0.0 or second_frame[t, p] != 0.0
            if tied and last > t and ahead:
                after, later = rows[t + 1, p], rows[last, p]
                one = next_frame[t, p]
                # In the last but one frame, whose second block is not used.
                two = second_frame[t, p] if last == t + 2 else 0.0
                for place in range(count):
                    i = active[place]
                    a0, a1, a2 = one * after[0, i], one * after[1, i], one * after[2, i]
                    b0, b1, b2 = two * later[0, i], two * later[1, i], two * later[2, i]
                    for j in range(end):
                        x, y, z = r[0, j], r[1, j], r[2, j]
                        blocks[1, t, i, j] += a0 * x + a1 * y + a2 * z
                        blocks[2, t, i, j] += b0 * x + b1 * y + b2 * z
    return blocks, gradient


@compile_kernel
def _round_up(count: int, most: int) -> int:
    """Return a length that vector instructions fill, at most `most`."""
    # Numbers that an unrolled loop of vector instructions takes at once [1]: the rest takes
    # longer.
    vector = 16
    return min((count + vector - 1) // vector * vector, most)


@compile_kernel
def propagate(rows: Floats, covariance: Floats) -> Floats:
    """Return the covariance of points (frames, points, 3, 3) [m^2].

    `rows` (frames, points, 3, n) are derivatives by n unknowns, most of them zero, whose covariance
    is (frames, n, n).
    """
    frames, points, _, size = rows.shape
    spread = np.empty((frames, points, 3, 3))
    held, active = np.empty((3, size)), np.empty(size, dtype=np.int64)
    for t in range(frames):
        for p in range(points):
            r, count = rows[t, p], _list_active(rows[t, p], active)
            held[:] = 0.0
            for place in range(count):
                i = active[place]
                f0, f1, f2 = r[0, i], r[1, i], r[2, i]
                for j in range(size):
                    c = covariance[t, i, j]
                    held[0, j] += f0 * c
                    held[1, j] += f1 * c
                    held[2, j] += f2 * c
            xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for place in range(count):
                i = active[place]
                xx += held[0, i] * r[0, i]
                xy += held[0, i] * r[1, i]
                xz += held[0, i] * r[2, i]
                yy += held[1, i] * r[1, i]
                yz += held[1, i] * r[2, i]
                zz += held[2, i] * r[2, i]
            target = spread[t, p]
            target[0, 0], target[1, 1], target[2, 2] = xx, yy, zz
            target[0, 1] = target[1, 0] = xy
            target[0, 2] = target[2, 0] = xz
            target[1, 2] = target[2, 1] = yz
    return spread


@compile_kernel
def propagate_alone(rows: Floats, information: Floats) -> Floats:
    """Return the covariance of points (frames, points, 3, 3) [m^2], each frame by itself.

    With the factor L of a frame's information L L^T, and Y = L^-1 R^T, the covariance R (L L^T)^-1
    R^T of all points is Y^T Y, whose blocks on the diagonal are those of the points. It is infinite
    where rounding leaves no factor.

    R are the rows (frames, points, 3, n); the information (frames, n, n) of the unknowns is valid
    in the lower triangle, and overwritten.
    """
    frames, points, _, size = rows.shape
    spread = np.empty((frames, points, 3, 3))
    turned, solved = np.empty((size, size)), np.empty((size, 3 * points))
    for t in range(frames):
        lower = information[t]
        if not factorize_block(lower, turned):
            spread[t] = np.inf
            continue
        solved[:] = rows[t].reshape(3 * points, size).T
        for i in range(size):
            own = solved[i]
            for k in range(i):
                factor, before = lower[i, k], solved[k]
                for column in range(3 * points):
                    own[column] -= factor * before[column]
            scale = 1.0 / lower[i, i]
            for column in range(3 * points):
                own[column] *= scale
        target = spread[t]
        target[:] = 0.0
        for i in range(size):
            for p in range(points):
                for a in range(3):
                    for b in range(3):
                        target[p, a, b] += solved[i, 3 * p + a] * solved[i, 3 * p + b]
    return spread


@compile_kernel
def _list_active(rows: Floats, active: NDArray[np.int64]) -> int:
    """List the nonzero columns of a matrix (m, n) in `active`; return their number."""
    count = 0
    for i in range(rows.shape[1]):
        for m in range(len(rows)):
            if rows[m, i] != 0.0:
                active[count] = i
                count += 1
                break
    return count
