"""Joints of a whole track, from reprojection errors and a penalty on acceleration.

The unknowns x, y, z of all frames form a symmetric matrix whose entries lie within six places of
the diagonal: a frame's own 3x3 block, and an acceleration ties each coordinate to those of two
frames before.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.triangulation.batched_gauss_newton import (
    LANES,
    MATRIX,
    POINT,
    PRECISION,
    RIGHT,
    ROWS,
    SHARPNESS,
    SQUARED,
    STATE,
    USED,
    accumulate,
    clear,
)
from worldpose.triangulation.observations import (
    Observations,
    Rig,
    gather,
    linearize,
)

BAND: Final = 6


class TrackCosts(NamedTuple):
    """Weights of errors of observations and of accelerations.

    Attributes:
        noise: noise of observations, [px] and [m].
        limit: scale of the Geman-McClure loss of observations [variances].
        penalty: on squared second differences [1/m^2].
    """

    noise: tuple[float, float]
    limit: float
    penalty: float


def solve_segment(
    pixels: Floats,
    weights: Floats,
    given: Floats,
    rig: Rig,
    costs: TrackCosts,
) -> tuple[Floats, Floats]:
    """Return a joint's points (frames, 3) [m] and covariance (frames, 3, 3) [m^2] over time.

    Args:
        pixels: (cameras, frames, 2) [px].
        weights: (cameras, frames), inverse of the factor on the stated variance; 0 or NaN = no
            observation.
        given: (frames, 3) [m], initial points; the first and last frame are not NaN.
        rig: the cameras.
        costs: weights of the two kinds of errors.
    """
    return solve_tiles(prepare_tiles(pixels, weights, rig), given, rig, costs)


def solve_tiles(tiles: Floats, given: Floats, rig: Rig, costs: TrackCosts) -> tuple[Floats, Floats]:
    """Return what `solve_segment` does, from the tiles of its observations."""
    frames = np.arange(len(given))
    known = np.isfinite(given[:, 0])
    columns = [np.interp(frames, frames[known], column[known]) for column in given.T]
    points = np.stack(columns, axis=-1)
    covariance = np.empty((len(points), 3, 3))
    _solve_track(tiles, rig.depths, costs, points, covariance)
    return points, covariance


def prepare_tiles(pixels: Floats, weights: Floats, rig: Rig) -> Floats:
    """Return tiles of one joint's observations, one lane per frame; all are used."""
    count, frames = weights.shape
    tiles = np.empty((-(-frames // LANES), count, ROWS * LANES))
    index = np.zeros((1, count, 1), np.int64)
    shape = (1, count, 1, frames)
    image = pixels.reshape(1, count, 1, frames, 2)
    _write_tiles(Observations.from_rig(rig, image, weights.reshape(shape), index), tiles)
    return tiles


@compile_kernel
def _write_tiles(observations: Observations, tiles: Floats) -> None:
    """Write the tiles of a track's observations (one frame, one person, a "joint" per frame)."""
    cameras = observations.cameras
    for part in range(len(tiles)):
        gather(observations, part * LANES, tiles[part])
        for camera in range(len(cameras)):
            linearize(tiles[part, camera], cameras, camera)
            tiles[part, camera, USED : USED + LANES] = 1.0


@compile_kernel
def _solve_track(
    tiles: Floats,
    depths: Floats,
    costs: TrackCosts,
    points: Floats,
    covariance: Floats,
) -> None:
    """Minimize reprojection errors and the acceleration penalty over the points of a track.

    Observations have a Geman-McClure loss of scale `costs.limit`.

    Args:
        tiles: tiles of `prepare_tiles`.
        depths: (cameras, 4).
        costs: weights of errors.
        points: (frames, 3) [m], initial values; written.
        covariance: (frames, 3, 3) [m^2], written.
    """
    frames = len(points)
    size = 3 * frames
    band, right = np.empty((size, BAND + 1)), np.empty(size)
    state = np.empty(STATE * LANES)
    for _ in range(12):
        _write_equations(tiles, depths, costs, points, state, band, right)
        _factorize(band)
        _substitute(band, right)
        largest = 0.0
        for i in range(size):
            points[i // 3, i % 3] += right[i]
            largest = max(largest, abs(right[i]))
        # Largest step of a coordinate that ends the iteration [m]: a hundredth of the noise.
        if not largest > 1e-4:
            break
    _invert(band)
    for t in range(frames):
        for a in range(3):
            for b in range(a + 1):
                value = band[3 * t + a, a - b]
                covariance[t, a, b] = covariance[t, b, a] = value


@compile_kernel
def held_out_cost(
    tiles: Floats, depths: Floats, noise: tuple[float, float], limit: float, points: Floats
) -> float:
    """Return the sum of the loss over the observations of a track at given points."""
    state = np.empty(STATE * LANES)
    total = 0.0
    for part in range(len(tiles)):
        _place(points, part, state)
        state[SHARPNESS : SHARPNESS + LANES] = 1.0 / limit
        clear(state)
        for camera in range(len(depths)):
            tile = tiles[part, camera]
            accumulate(tile, depths[camera], noise, state)
            for j in range(min(LANES, len(points) - part * LANES)):
                if tile[PRECISION + j] > 0.0:
                    squared = tile[SQUARED + j]
                    total += limit if squared == math.inf else limit * squared / (limit + squared)
    return total


@compile_kernel
def _place(points: Floats, part: int, state: Floats) -> None:
    """Copy the points of one tile into its state."""
    for j in range(LANES):
        t = min(part * LANES + j, len(points) - 1)
        for axis in range(3):
            state[POINT + axis * LANES + j] = points[t, axis]


@compile_kernel
def _write_equations(
    tiles: Floats,
    depths: Floats,
    costs: TrackCosts,
    points: Floats,
    state: Floats,
    band: Floats,
    right: Floats,
) -> None:
    """Write the Gauss-Newton matrix by rows, `band[i, k]` = entry (i, i - k), and right side."""
    noise, limit, penalty = costs.noise, costs.limit, costs.penalty
    frames = len(points)
    band[:] = 0.0
    for part in range(len(tiles)):
        _place(points, part, state)
        state[SHARPNESS : SHARPNESS + LANES] = 1.0 / limit
        clear(state)
        for camera in range(len(depths)):
            accumulate(tiles[part, camera], depths[camera], noise, state)
        for j in range(min(LANES, frames - part * LANES)):
            i = 3 * (part * LANES + j)
            band[i, 0] = state[MATRIX + j]
            band[i + 1, 1] = state[MATRIX + LANES + j]
            band[i + 2, 2] = state[MATRIX + 2 * LANES + j]
            band[i + 1, 0] = state[MATRIX + 3 * LANES + j]
            band[i + 2, 1] = state[MATRIX + 4 * LANES + j]
            band[i + 2, 0] = state[MATRIX + 5 * LANES + j]
            for axis in range(3):
                right[i + axis] = state[RIGHT + axis * LANES + j]
    for t in range(2, frames):
        for axis in range(3):
            i = 3 * t + axis
            bend = points[t, axis] - 2.0 * points[t - 1, axis] + points[t - 2, axis]
            right[i] -= penalty * bend
            right[i - 3] += 2.0 * penalty * bend
            right[i - 6] -= penalty * bend
            band[i, 0] += penalty
            band[i - 3, 0] += 4.0 * penalty
            band[i - 6, 0] += penalty
            band[i, 3] -= 2.0 * penalty
            band[i - 3, 3] -= 2.0 * penalty
            band[i, 6] += penalty


@compile_kernel
def _factorize(band: Floats) -> None:
    """Replace the matrix by its Cholesky factor, `band[i, k]` = L(i, i - k)."""
    for i in range(len(band)):
        for k in range(min(BAND, i), -1, -1):
            j = i - k
            total = band[i, k]
            for m in range(k + 1, min(BAND, i) + 1):
                if m - k <= BAND:
                    total -= band[i, m] * band[j, m - k]
            band[i, k] = math.sqrt(total) if k == 0 else total / band[j, 0]


@compile_kernel
def _substitute(band: Floats, right: Floats) -> None:
    """Replace the right side by the solution."""
    size = len(right)
    for i in range(size):
        for k in range(1, min(BAND, i) + 1):
            right[i] -= band[i, k] * right[i - k]
        right[i] /= band[i, 0]
    for i in range(size - 1, -1, -1):
        for k in range(1, min(BAND, size - 1 - i) + 1):
            right[i] -= band[i + k, k] * right[i + k]
        right[i] /= band[i, 0]


@compile_kernel
def _invert(band: Floats) -> None:
    """Replace the factor by the inverse's entries within the band (Takahashi 1973)."""
    size = len(band)
    row = np.empty(BAND + 1)
    for i in range(size - 1, -1, -1):
        reach = min(BAND, size - 1 - i)
        diagonal = band[i, 0]
        # Column i of the factor below the diagonal, before its places are overwritten.
        for k in range(1, reach + 1):
            row[k] = band[i + k, k]
        for k in range(reach, -1, -1):
            j = i + k
            total = 1.0 / diagonal if k == 0 else 0.0
            for m in range(1, reach + 1):
                low, high = min(i + m, j), max(i + m, j)
                total -= row[m] * band[high, high - low]
            band[j, k] = total / diagonal
