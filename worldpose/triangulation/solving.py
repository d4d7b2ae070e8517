"""Triangulation of every joint of a clip from its inlier observations, for 64 joints at a time.

Tiles, states and their rows are those of `batched_gauss_newton`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.triangulation.batched_gauss_newton import (
    CHANGED,
    INSIDE,
    LANES,
    MATRIX,
    POINT,
    PRECISION,
    ROWS,
    SEEN,
    SHARPNESS,
    SQUARED,
    STATE,
    STEP,
    USED,
    WORST,
    largest,
    measure,
    select,
    start,
    step,
    survey,
)
from worldpose.triangulation.observations import Observations, gather, linearize
from worldpose.triangulation.settings import TriangulationSettings


@compile_kernel
def consensus(
    tiles: Floats,
    depths: Floats,
    noise: tuple[float, float],
    limit: float,
    state: Floats,
) -> None:
    """Write the least-squares points of the inlier views, NaN where there are none.

    The first attempt uses all views. If they disagree, a Geman-McClure loss whose scale shrinks
    from the largest error to `limit` finds a majority (graduated non-convexity, Blake and Zisserman
    1987). Without a majority, the pair of views with the smallest error over all views decides. The
    result is the plain least-squares point of the views within `limit`.

    Args:
        tiles: (cameras, ROWS x LANES); writes `USED`.
        depths: (cameras, 4).
        noise: [px], [m].
        limit: largest squared error of an inlier [variances].
        state: written: points, and the inverse matrices there.
    """
    for tile in tiles:
        # Start with all available views.
        tile[SQUARED : SQUARED + LANES] = 0.0
    select(tiles, limit, state)
    state[SHARPNESS : SHARPNESS + LANES] = 0.0
    start(tiles, state)
    step(tiles, depths, noise, state)
    if _graduate(tiles, depths, noise, limit, state):
        survey(tiles, limit, state)
        for j in range(LANES):
            if state[SHARPNESS + j] > 0.0:
                inside = state[INSIDE + j]
                # A majority of three or more agrees by chance too rarely to look further.
                if inside < 3 or 2 * inside <= state[SEEN + j]:
                    _take_best_pair(tiles, depths, noise, limit, j, state)
        state[SHARPNESS : SHARPNESS + LANES] = 0.0
    # Updates of the inlier set; it settles after one or two.
    for _ in range(5):
        select(tiles, limit, state)
        if not largest(state, CHANGED) > 0.0:
            break
        step(tiles, depths, noise, state)
        step(tiles, depths, noise, state)
    for _ in range(8):
        step(tiles, depths, noise, state)
        # Length of a step that ends the iteration [m].
        if not largest(state, STEP) > 1e-6**2:
            break


@compile_kernel
def _graduate(
    tiles: Floats, depths: Floats, noise: tuple[float, float], limit: float, state: Floats
) -> bool:
    """Move joints with disagreeing views to a majority's point; return whether there are any.

    Their loss scale ends at `limit`; the loss scale of all other joints is infinite.
    """
    survey(tiles, limit, state)
    most = 0.0
    for j in range(LANES):
        if state[INSIDE + j] < state[SEEN + j]:
            worst = max(state[WORST + j], limit)
            state[SHARPNESS + j] = 1.0 / worst
            most = max(most, worst)
    if most == 0.0:
        return False
    shrink = 0.1  # Factor on the scale of the loss from step to step [1].
    while True:
        step(tiles, depths, noise, state)
        if most <= limit:
            break
        most *= shrink
        for j in range(LANES):
            state[SHARPNESS + j] = min(1.0 / limit, state[SHARPNESS + j] / shrink)
    # Errors refer to the state before a step: one more step updates them.
    step(tiles, depths, noise, state)
    return True


@compile_kernel
def _take_best_pair(
    tiles: Floats,
    depths: Floats,
    noise: tuple[float, float],
    limit: float,
    lane: int,
    state: Floats,
) -> None:
    """Set a lane to the two-view point with the smallest truncated error over all views."""
    views = np.empty(len(tiles), np.int64)
    count = 0
    for camera in range(len(tiles)):
        if tiles[camera, PRECISION + lane] > 0.0:
            views[count] = camera
            count += 1
    pairs = np.empty((LANES, 2), np.int64)
    trial, trial_depths = np.empty((count, ROWS * LANES)), np.empty((count, 4))
    for k in range(count):
        trial_depths[k] = depths[views[k]]
        for row in range(ROWS):
            trial[k, row * LANES : (row + 1) * LANES] = tiles[views[k], row * LANES + lane]
    points = np.empty(STATE * LANES)
    best, filled = math.inf, 0
    for one in range(count):
        for two in range(one + 1, count):
            pairs[filled, 0], pairs[filled, 1] = one, two
            filled += 1
            if filled < LANES and (one, two) != (count - 2, count - 1):
                continue
            for k in range(count):
                for j in range(LANES):
                    among = j < filled and (pairs[j, 0] == k or pairs[j, 1] == k)
                    trial[k, USED + j] = 1.0 if among else 0.0
            points[SHARPNESS : SHARPNESS + LANES] = 0.0
            start(trial, points)
            at = points[POINT : POINT + 3 * LANES].copy()
            step(trial, trial_depths, noise, points)
            for j in range(filled):
                cost = 0.0
                for k in range(count):
                    squared = trial[k, SQUARED + j]
                    cost += squared if squared < limit else limit
                if cost < best:
                    best = cost
                    for axis in range(3):
                        state[POINT + axis * LANES + lane] = at[axis * LANES + j]
                    for k in range(count):
                        tiles[views[k], SQUARED + lane] = trial[k, SQUARED + j]
            filled = 0


class Solution(NamedTuple):
    """Joints with covariance and inliers; the arrays are those of `Triangulation`.

    Attributes:
        seen: (frames, cameras, persons, joints) bool, whether there is an observation.
    """

    joints: Floats
    covariance: Floats
    views: NDArray[np.uint8]
    spread: NDArray[np.float32]
    reprojection_error: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    seen: NDArray[np.bool_]


def solve_joints(observations: Observations, settings: TriangulationSettings) -> Solution:
    """Return the joints of all frames, with covariance from `precision` and the stated noise."""
    frames, count, persons = observations.detection_index.shape
    shape = (frames, persons, observations.precision.shape[-1])
    solution = Solution(
        joints=np.full((*shape, 3), np.nan),
        covariance=np.full((*shape, 3, 3), np.nan),
        views=np.zeros(shape, np.uint8),
        spread=np.full(shape, np.nan, np.float32),
        reprojection_error=np.full(shape, np.nan, np.float32),
        inliers=np.zeros((frames, count, *shape[1:]), np.bool_),
        seen=np.zeros((frames, count, *shape[1:]), np.bool_),
    )
    _solve_all(
        observations,
        settings.noise,
        settings.max_deviation**2,
        settings.min_views,
        math.sin(settings.min_angle_rad),
        solution,
    )
    return solution


@compile_kernel
def _solve_all(
    observations: Observations,
    noise: tuple[float, float],
    limit: float,
    min_views: int,
    min_sine: float,
    solution: Solution,
) -> None:
    """Solve tile by tile and write the arrays of `solution`."""
    precision, index = observations.precision, observations.detection_index
    cameras, depths, centers = observations.cameras, observations.depths, observations.centers
    joints, covariance, views = solution.joints, solution.covariance, solution.views
    spread, error = solution.spread, solution.reprojection_error
    inliers, seen = solution.inliers, solution.seen
    frames, count, persons = index.shape
    joint_count = precision.shape[3]
    tiles, rays = np.empty((count, ROWS * LANES)), np.empty((count, 3 * LANES))
    state, sums = np.empty(STATE * LANES), np.empty(STATE * LANES)
    found, place = np.zeros(LANES, np.bool_), np.empty((LANES, 3), np.int64)
    agrees = np.empty((2, LANES), np.bool_)
    total = frames * persons * joint_count
    for first in range(0, total, LANES):
        gather(observations, first, tiles)
        for camera in range(count):
            linearize(tiles[camera], cameras, camera)
        consensus(tiles, depths, noise, limit, state)
        sums[:] = state
        measure(tiles, depths, centers, sums, rays)
        last = min(LANES, total - first)
        for j in range(last):
            at = first + j
            t, n, joint = (
                at // (joint_count * persons),
                (at // joint_count) % persons,
                at % joint_count,
            )
            place[j] = t, n, joint
            x, y, z = state[POINT + j], state[POINT + LANES + j], state[POINT + 2 * LANES + j]
            xx, xy, xz = state[MATRIX + j], state[MATRIX + LANES + j], state[MATRIX + 2 * LANES + j]
            yy, yz = state[MATRIX + 3 * LANES + j], state[MATRIX + 4 * LANES + j]
            zz = state[MATRIX + 5 * LANES + j]
            agreed, widest = sums[MATRIX + LANES + j], math.sqrt(sums[MATRIX + 2 * LANES + j])
            found[j] = math.isfinite(x + xx) and widest >= min_sine and agreed >= min_views
            if found[j]:
                joints[t, n, joint] = x, y, z
                covariance[t, n, joint, 0] = xx, xy, xz
                covariance[t, n, joint, 1] = xy, yy, yz
                covariance[t, n, joint, 2] = xz, yz, zz
                views[t, n, joint] = int(agreed)
                spread[t, n, joint] = math.asin(min(1.0, widest))
                error[t, n, joint] = math.sqrt(sums[MATRIX + j] / agreed)
        for camera in range(count):
            tile = tiles[camera]
            for j in range(LANES):
                agrees[0, j] = tile[PRECISION + j] > 0.0
                agrees[1, j] = found[j] & (tile[USED + j] > 0.0)
            j = 0
            while j < last:
                t, n, joint = place[j]
                run = min(joint_count - joint, last - j)
                there, agreed_here = seen[t, camera, n, joint:], inliers[t, camera, n, joint:]
                for k in range(run):
                    there[k], agreed_here[k] = agrees[0, j + k], agrees[1, j + k]
                j += run
