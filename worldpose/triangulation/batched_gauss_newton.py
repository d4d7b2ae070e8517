"""Batched Gauss-Newton on reprojection errors: 64 joints at a time, one SIMD lane per joint.

A tile is one flat array per camera: `ROWS` rows of `LANES` numbers. Each observation is linearised
at its own pixel: with X = (x, y, z, 1) and depth p X, its error is (a X, b X) / (p X) [px]. The
state of a tile is one flat array of `STATE` rows.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel

LANES: Final = 64
"""Joints per tile: 16 cameras x 64 joints fit the L2 cache of a processor core."""

# Rows of an observation.
A: Final = 0
B: Final = 4 * LANES
SCALE: Final = 8 * LANES
"""Image area of a unit area at depth one [px^2]."""
PRECISION: Final = 9 * LANES
"""Inverse of the factor on the image noise variance; 0 = no observation."""
EXTRA: Final = 10 * LANES
"""Variance in addition to the image noise [px^2]."""
USED: Final = 11 * LANES
"""1 = inlier or assumed to be one, 0 = left out."""
SQUARED: Final = 12 * LANES
"""Squared error over its variance, written by `accumulate`; infinite behind the camera."""
LEVERAGE: Final = 13 * LANES
"""Leverage of the observation, at most 2, written by `weigh`."""
ROWS: Final = 14

# Rows of a state.
POINT: Final = 0
SHARPNESS: Final = 3 * LANES
"""Inverse scale of the Geman-McClure loss in units of variance; 0 = least squares."""
MATRIX: Final = 4 * LANES
"""Sums of xx xy xz yy yz zz."""
RIGHT: Final = 10 * LANES
STEP: Final = 13 * LANES
"""Squared length of the last step [m^2]."""
SEEN: Final = 14 * LANES
"""Number of views, written by `survey`."""
INSIDE: Final = 15 * LANES
"""Number of views within the limit."""
WORST: Final = 16 * LANES
"""Largest finite squared error."""
CHANGED: Final = 17 * LANES
"""Number of views whose inlier state changed, written by `select`."""
STATE: Final = 18


@compile_kernel
def clear(state: Floats) -> None:
    """Set the sums of a state to zero."""
    state[MATRIX : MATRIX + 9 * LANES] = 0.0


@compile_kernel
def accumulate_linear(tile: Floats, state: Floats) -> None:
    """Add one camera's equations a X = 0, b X = 0 to the sums."""
    for j in range(LANES):
        w = tile[USED + j] * tile[SCALE + j]
        w = w if tile[PRECISION + j] > 0.0 else 0.0
        for row in (A, B):
            x, y = tile[row + j], tile[row + LANES + j]
            z, r = tile[row + 2 * LANES + j], tile[row + 3 * LANES + j]
            state[MATRIX + j] += w * x * x
            state[MATRIX + LANES + j] += w * x * y
            state[MATRIX + 2 * LANES + j] += w * x * z
            state[MATRIX + 3 * LANES + j] += w * y * y
            state[MATRIX + 4 * LANES + j] += w * y * z
            state[MATRIX + 5 * LANES + j] += w * z * z
            state[RIGHT + j] -= w * x * r
            state[RIGHT + LANES + j] -= w * y * r
            state[RIGHT + 2 * LANES + j] -= w * z * r


@compile_kernel
def accumulate(tile: Floats, depth: Floats, noise: tuple[float, float], state: Floats) -> None:
    """Add one camera's Gauss-Newton equations at the points to the sums.

    Args:
        tile: one camera's rows; writes `SQUARED`.
        depth: (4,), p of the camera.
        noise: standard deviation of the image noise [px], and of its part at the joint [m].
        state: points and sharpness of the loss; writes the sums.
    """
    p, q, r, s = depth[0], depth[1], depth[2], depth[3]
    pixel, metric = noise[0] ** 2, noise[1] ** 2
    for j in range(LANES):
        x, y, z = state[POINT + j], state[POINT + LANES + j], state[POINT + 2 * LANES + j]
        away = p * x + q * y + r * z + s
        a0, a1, a2 = tile[A + j], tile[A + LANES + j], tile[A + 2 * LANES + j]
        b0, b1, b2 = tile[B + j], tile[B + LANES + j], tile[B + 2 * LANES + j]
        along = a0 * x + a1 * y + a2 * z + tile[A + 3 * LANES + j]
        across = b0 * x + b1 * y + b2 * z + tile[B + 3 * LANES + j]
        inverse = 1.0 / away
        e, f = along * inverse, across * inverse
        size = tile[SCALE + j] * inverse * inverse
        g = tile[PRECISION + j]
        weight = g / (pixel + size * metric + g * tile[EXTRA + j])
        squared = (e * e + f * f) * weight
        down = inverse / (1.0 + squared * state[SHARPNESS + j])
        squared = squared if away > 0.0 else np.inf
        tile[SQUARED + j] = squared
        # The derivative of an error is (a - e p) / depth: the weight has its squared depth.
        weight *= down * down * tile[USED + j]
        weight = weight if away > 0.0 else 0.0
        ax, ay, az = a0 - e * p, a1 - e * q, a2 - e * r
        bx, by, bz = b0 - f * p, b1 - f * q, b2 - f * r
        wax, way, waz = weight * ax, weight * ay, weight * az
        wbx, wby, wbz = weight * bx, weight * by, weight * bz
        state[MATRIX + j] += wax * ax + wbx * bx
        state[MATRIX + LANES + j] += wax * ay + wbx * by
        state[MATRIX + 2 * LANES + j] += wax * az + wbx * bz
        state[MATRIX + 3 * LANES + j] += way * ay + wby * by
        state[MATRIX + 4 * LANES + j] += way * az + wby * bz
        state[MATRIX + 5 * LANES + j] += waz * az + wbz * bz
        state[RIGHT + j] -= wax * along + wbx * across
        state[RIGHT + LANES + j] -= way * along + wby * across
        state[RIGHT + 2 * LANES + j] -= waz * along + wbz * across


@compile_kernel
def invert(state: Floats) -> None:
    """Replace the matrix by its inverse, NaN where it is singular to working precision."""
    for j in range(LANES):
        a, b, c = state[MATRIX + j], state[MATRIX + LANES + j], state[MATRIX + 2 * LANES + j]
        d = state[MATRIX + 3 * LANES + j]
        e, f = state[MATRIX + 4 * LANES + j], state[MATRIX + 5 * LANES + j]
        p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
        determinant = a * p + b * q + c * r
        # Determinant over product of the diagonal below which rounding dominates the result [1].
        over = 1.0 / determinant if determinant > 1e-14 * a * d * f else np.nan
        state[MATRIX + j] = p * over
        state[MATRIX + LANES + j] = q * over
        state[MATRIX + 2 * LANES + j] = r * over
        state[MATRIX + 3 * LANES + j] = (a * f - c * c) * over
        state[MATRIX + 4 * LANES + j] = (b * c - a * e) * over
        state[MATRIX + 5 * LANES + j] = (a * d - b * b) * over


@compile_kernel
def move(state: Floats) -> None:
    """Add the solution of the sums to the points; the matrix becomes its inverse."""
    invert(state)
    for j in range(LANES):
        a, b, c = state[MATRIX + j], state[MATRIX + LANES + j], state[MATRIX + 2 * LANES + j]
        d = state[MATRIX + 3 * LANES + j]
        e, f = state[MATRIX + 4 * LANES + j], state[MATRIX + 5 * LANES + j]
        u, v, w = state[RIGHT + j], state[RIGHT + LANES + j], state[RIGHT + 2 * LANES + j]
        x, y, z = a * u + b * v + c * w, b * u + d * v + e * w, c * u + e * v + f * w
        state[POINT + j] += x
        state[POINT + LANES + j] += y
        state[POINT + 2 * LANES + j] += z
        state[STEP + j] = x * x + y * y + z * z


@compile_kernel
def start(tiles: Floats, state: Floats) -> None:
    """Set the points to the linear least-squares ones (inhomogeneous DLT) of the used views."""
    clear(state)
    for camera in range(len(tiles)):
        accumulate_linear(tiles[camera], state)
    state[POINT : POINT + 3 * LANES] = 0.0
    move(state)


@compile_kernel
def step(tiles: Floats, depths: Floats, noise: tuple[float, float], state: Floats) -> None:
    """Take one Gauss-Newton step; errors and the inverted matrix refer to the state before it."""
    clear(state)
    for camera in range(len(tiles)):
        accumulate(tiles[camera], depths[camera], noise, state)
    move(state)


@compile_kernel
def weigh(tile: Floats, depth: Floats, noise: tuple[float, float], state: Floats) -> None:
    """Write the leverage of one camera's observations; the matrix is already inverted."""
    pixel, metric = noise[0] ** 2, noise[1] ** 2
    for j in range(LANES):
        x, y, z = state[POINT + j], state[POINT + LANES + j], state[POINT + 2 * LANES + j]
        inverse = 1.0 / (depth[0] * x + depth[1] * y + depth[2] * z + depth[3])
        base = pixel + tile[SCALE + j] * inverse * inverse * metric
        g = tile[PRECISION + j]
        weight = tile[USED + j] * g / (base + g * tile[EXTRA + j]) * inverse * inverse
        total = 0.0
        for row in (A, B):
            a, b, c = tile[row + j], tile[row + LANES + j], tile[row + 2 * LANES + j]
            e = (a * x + b * y + c * z + tile[row + 3 * LANES + j]) * inverse
            a, b, c = a - e * depth[0], b - e * depth[1], c - e * depth[2]
            total += a * a * state[MATRIX + j] + b * b * state[MATRIX + 3 * LANES + j]
            total += c * c * state[MATRIX + 5 * LANES + j]
            total += 2.0 * a * b * state[MATRIX + LANES + j]
            total += (
                2.0 * c * (a * state[MATRIX + 2 * LANES + j] + b * state[MATRIX + 4 * LANES + j])
            )
        tile[LEVERAGE + j] = weight * total


@compile_kernel
def survey(tiles: Floats, limit: float, state: Floats) -> None:
    """Write the number of views, the number of views within the limit, and the largest error."""
    state[SEEN : SEEN + 3 * LANES] = 0.0
    for camera in range(len(tiles)):
        _survey_view(tiles[camera], limit, state)


@compile_kernel
def _survey_view(tile: Floats, limit: float, state: Floats) -> None:
    for j in range(LANES):
        there = tile[PRECISION + j] > 0.0
        squared, worst = tile[SQUARED + j], state[WORST + j]
        state[SEEN + j] += 1.0 if there else 0.0
        state[INSIDE + j] += 1.0 if there & (squared <= limit) else 0.0
        state[WORST + j] = squared if there & (squared < np.inf) & (squared > worst) else worst


@compile_kernel
def select(tiles: Floats, limit: float, state: Floats) -> None:
    """Mark the views within the limit as used; write the number of views that changed."""
    state[CHANGED : CHANGED + LANES] = 0.0
    for camera in range(len(tiles)):
        _select_view(tiles[camera], limit, state)


@compile_kernel
def _select_view(tile: Floats, limit: float, state: Floats) -> None:
    for j in range(LANES):
        precision, squared, before = tile[PRECISION + j], tile[SQUARED + j], tile[USED + j]
        used = 1.0 if (precision > 0.0) & (squared <= limit) else 0.0
        state[CHANGED + j] += (used - before) * (used - before)
        tile[USED + j] = used


@compile_kernel
def largest(state: Floats, row: int) -> float:
    """Return the largest number of a row of a state, ignoring NaN."""
    value = 0.0
    for j in range(LANES):
        value = state[row + j] if state[row + j] > value else value
    return value


@compile_kernel
def measure(tiles: Floats, depths: Floats, centers: Floats, state: Floats, rays: Floats) -> None:
    """Measure the used views of each point, and write three sums to the state.

    The rows of the state from `MATRIX` on receive the sum of squared pixel errors, the number of
    used views, and their spread: the largest squared sine of an angle between two rays.
    """
    sums, views, widest = MATRIX, MATRIX + LANES, MATRIX + 2 * LANES
    state[sums : sums + 2 * LANES] = 0.0
    state[widest : widest + LANES] = 1.0
    for camera in range(len(tiles)):
        tile, ray = tiles[camera], rays[camera]
        p, q, r, s = depths[camera, 0], depths[camera, 1], depths[camera, 2], depths[camera, 3]
        cx, cy, cz = centers[camera, 0], centers[camera, 1], centers[camera, 2]
        for j in range(LANES):
            x, y, z = state[POINT + j], state[POINT + LANES + j], state[POINT + 2 * LANES + j]
            inverse = 1.0 / (p * x + q * y + r * z + s)
            e = tile[A + j] * x + tile[A + LANES + j] * y + tile[A + 2 * LANES + j] * z
            f = tile[B + j] * x + tile[B + LANES + j] * y + tile[B + 2 * LANES + j] * z
            e = (e + tile[A + 3 * LANES + j]) * inverse
            f = (f + tile[B + 3 * LANES + j]) * inverse
            used = tile[USED + j]
            state[sums + j] += (e * e + f * f) * used
            state[views + j] += used
            x, y, z = x - cx, y - cy, z - cz
            length = 1.0 / np.sqrt(x * x + y * y + z * z)
            # A NaN ray contributes no angle.
            length = length if used > 0.0 else np.nan
            ray[j], ray[LANES + j], ray[2 * LANES + j] = x * length, y * length, z * length
    for camera in range(len(tiles)):
        one = rays[camera]
        for other in range(camera):
            two = rays[other]
            for j in range(LANES):
                dot = one[j] * two[j]
                dot += one[LANES + j] * two[LANES + j] + one[2 * LANES + j] * two[2 * LANES + j]
                square, least = dot * dot, state[widest + j]
                state[widest + j] = square if square < least else least
    for j in range(LANES):
        state[widest + j] = 1.0 - state[widest + j]
