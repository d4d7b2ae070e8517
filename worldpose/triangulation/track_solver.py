"""E_track of one joint: minimization over all frames of its track.

The unknowns x, y, z of all frames form a symmetric matrix whose entries lie within six places of
the diagonal: a frame's own 3x3 block, and an acceleration ties each coordinate to those of two
frames before.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel
from worldpose.triangulation.residuals import (
    LANES,
    TILE,
    Buffers,
    Observations,
    Rig,
    State,
    Tiles,
    add_data,
    add_smoothness,
    clear,
    read_tile,
)

BAND: Final = 6


class PersonKeypoints(NamedTuple):
    """Keypoints of one person over an interval of frames.

    Attributes:
        pixels: (joints, cameras, frames, 2) [px], offsets subtracted.
        precision: (joints, cameras, frames) precision as in `Observations`.
        joints: (frames, joints, 3) [m], triangulated; NaN where unknown.
    """

    pixels: Floats
    precision: Floats
    joints: Floats


def select_person(
    detections: KeypointDetections,
    precision: Floats,
    offsets: Floats,
    joints: Floats,
    person: int,
    frames: slice = slice(None),
) -> PersonKeypoints:
    """Return one person's keypoints in the frames to include.

    Precision is (frames, cameras, detections, joints), offsets to subtract (frames, cameras,
    persons, 2) [px], triangulated joints (frames, persons, joints, 3) [m].
    """
    index = detections.detection_index[frames, :, person]
    # Whole rows of joints: `take_along_axis` would index every number, at ten times the time.
    row, camera = np.ogrid[: index.shape[0], : index.shape[1]]
    place = row, camera, np.maximum(index, 0)
    pixels = detections.keypoints[frames][place] - offsets[frames, :, person, None]
    weights = precision[frames][place]
    weights = np.where((index >= 0)[..., None], weights, np.nan)
    return PersonKeypoints(
        pixels=np.ascontiguousarray(pixels.transpose(2, 1, 0, 3)),
        precision=np.ascontiguousarray(weights.transpose(2, 1, 0)),
        joints=joints[frames, person],
    )


class TrackCosts(NamedTuple):
    """Weights of errors of observations and of accelerations.

    Attributes:
        noise: of observations, [px] and [m].
        limit: scale of the Geman-McClure loss of observations [variances].
        penalty: on squared second differences [1/m^2].
    """

    noise: tuple[float, float]
    limit: float
    penalty: float


def solve_tiles(tiles: Tiles, given: Floats, rig: Rig, costs: TrackCosts) -> tuple[Floats, Floats]:
    """Return a joint's points (frames, 3) [m] and covariance (frames, 3, 3) [m^2] over time.

    The tiles are of `prepare_tiles`. The first and last frame of the initial points `given`
    (frames, 3) [m] are not NaN.
    """
    frames = np.arange(len(given))
    known = np.isfinite(given[:, 0])
    columns = [np.interp(frames, frames[known], column[known]) for column in given.T]
    points = np.stack(columns, axis=-1)
    covariance = np.empty((len(points), 3, 3))
    _solve_track(tiles, rig.depths, costs, Buffers.of(0).state, points, covariance)
    return points, covariance


def prepare_tiles(pixels: Floats, weights: Floats, rig: Rig) -> Tiles:
    """Return tiles (parts, cameras) of one joint's observations, one lane per frame; all used.

    Weights (cameras, frames) are the inverse of the factor on the stated variance of pixels
    (cameras, frames, 2); 0 or NaN = no observation.
    """
    count, frames = weights.shape
    tiles = np.zeros((-(-frames // LANES), count), TILE)
    index = np.zeros((1, count, 1), np.int64)
    image = pixels.reshape(1, count, 1, frames, 2)
    precision = weights.reshape(1, count, 1, frames)
    # One frame, one person, a "joint" per frame.
    _write_tiles(Observations.of(rig, image, precision, index), tiles)
    tiles["used"] = 1.0
    return tiles


@compile_kernel
def _write_tiles(observations: Observations, tiles: Tiles) -> None:
    """Write the tiles (parts, cameras) of a track's observations."""
    for part in range(len(tiles)):
        read_tile(observations, part * LANES, tiles[part])


@compile_kernel
def _solve_track(
    tiles: Tiles,
    depths: Floats,
    costs: TrackCosts,
    state: Tiles,
    points: Floats,
    covariance: Floats,
) -> None:
    """Minimize E_track over the points of a track.

    Observations have a Geman-McClure loss of scale `costs.limit`. Depths are (cameras, 4), and
    `state` (1,) is room for one. `points` (frames, 3) [m] are initial values, written as is
    `covariance` (frames, 3, 3) [m^2].
    """
    frames = len(points)
    size = 3 * frames
    band, right = np.empty((size, BAND + 1)), np.empty(size)
    for _ in range(12):
        _write_equations(tiles, depths, costs, points, state[0], band, right)
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


def held_out_cost(
    tiles: Tiles, depths: Floats, noise: tuple[float, float], limit: float, points: Floats
) -> float:
    """Return E_data, summed over the observations of a track at given points."""
    return float(_sum_costs(tiles, depths, noise, limit, points, Buffers.of(0).state))


@compile_kernel
def _sum_costs(
    tiles: Tiles,
    depths: Floats,
    noise: tuple[float, float],
    limit: float,
    points: Floats,
    states: Tiles,
) -> float:
    state, total = states[0], 0.0
    for part in range(len(tiles)):
        _add_part(tiles[part], depths, noise, limit, points, part, state)
        for camera in range(len(depths)):
            precision, errors = tiles[part, camera]["precision"], tiles[part, camera]["squared"]
            for j in range(min(LANES, len(points) - part * LANES)):
                if precision[j] > 0.0:
                    squared = errors[j]
                    total += limit if squared == math.inf else limit * squared / (limit + squared)
    return total


@compile_kernel
def _add_part(
    tiles: Tiles,
    depths: Floats,
    noise: tuple[float, float],
    limit: float,
    points: Floats,
    part: int,
    state: State,
) -> None:
    """Write the equations of E_data of 64 frames to a state, with a loss of scale `limit`."""
    for j in range(LANES):
        t = min(part * LANES + j, len(points) - 1)
        for axis in range(3):
            state["point"][axis, j] = points[t, axis]
    state["sharpness"][:] = 1.0 / limit
    clear(state)
    for camera in range(len(depths)):
        add_data(tiles[camera], depths[camera], noise, state)


@compile_kernel
def _write_equations(
    tiles: Tiles,
    depths: Floats,
    costs: TrackCosts,
    points: Floats,
    state: State,
    band: Floats,
    right: Floats,
) -> None:
    """Write the Gauss-Newton matrix by rows, `band[i, k]` = entry (i, i - k), and right side."""
    matrix, side = state["matrix"], state["right"]
    frames = len(points)
    band[:] = 0.0
    for part in range(len(tiles)):
        _add_part(tiles[part], depths, costs.noise, costs.limit, points, part, state)
        for j in range(min(LANES, frames - part * LANES)):
            i = 3 * (part * LANES + j)
            band[i, 0], band[i + 1, 1], band[i + 2, 2] = matrix[0, j], matrix[1, j], matrix[2, j]
            band[i + 1, 0], band[i + 2, 1], band[i + 2, 0] = (
                matrix[3, j],
                matrix[4, j],
                matrix[5, j],
            )
            for axis in range(3):
                right[i + axis] = side[axis, j]
    add_smoothness(points, costs.penalty, band, right)


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
