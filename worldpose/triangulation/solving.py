"""Triangulation of every joint of a clip from its inlier observations."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.triangulation.batched_gauss_newton import (
    LANES,
    MATRIX,
    POINT,
    PRECISION,
    ROWS,
    STATE,
    USED,
    measure,
)
from worldpose.triangulation.consensus import consensus
from worldpose.triangulation.observations import Observations, gather, linearize
from worldpose.triangulation.settings import TriangulationSettings


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
    """Return the joints of all frames, with covariance from `precision` and the stated noise.

    Args:
        observations: of all tracked people.
        settings: noise, inlier limit and minimum views.
    """
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
            linearize(tiles[camera], cameras[camera])
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
