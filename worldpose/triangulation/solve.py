"""Robust least squares of E_data: every joint of a clip from its inlier views, 64 at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.triangulation.residuals import (
    LANES,
    Buffers,
    Observations,
    Rig,
    State,
    Tile,
    Tiles,
    add_data,
    add_linear_data,
    clear,
    read_tile,
)
from worldpose.triangulation.settings import TriangulationSettings


class SolvedJoints(NamedTuple):
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


def solve_joints(observations: Observations, settings: TriangulationSettings) -> SolvedJoints:
    """Return the joints of all frames, with covariance from `precision` and the stated noise."""
    frames, count, persons = observations.detection_index.shape
    shape = (frames, persons, observations.precision.shape[-1])
    solved = SolvedJoints(
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
        Buffers.of(count),
        solved,
    )
    return solved


@compile_kernel
def _solve_all(
    observations: Observations,
    noise: tuple[float, float],
    limit: float,
    min_views: int,
    min_sine: float,
    buffers: Buffers,
    solved: SolvedJoints,
) -> None:
    """Solve tile by tile and write the arrays of `solved`."""
    frames, count, persons = observations.detection_index.shape
    joint_count = observations.precision.shape[3]
    tiles, state = buffers.tiles, buffers.state[0]
    found, place = np.zeros(LANES, np.bool_), np.empty((LANES, 3), np.int64)
    agrees = np.empty((2, LANES), np.bool_)
    total = frames * persons * joint_count
    for first in range(0, total, LANES):
        read_tile(observations, first, tiles)
        find_consensus(observations.rig, noise, limit, buffers)
        _measure(tiles, observations.rig, buffers.rays, state)
        last = min(LANES, total - first)
        for j in range(last):
            person, place[j, 2] = (first + j) // joint_count, (first + j) % joint_count
            place[j, 0], place[j, 1] = person // persons, person % persons
        _write_joints(state, place[:last], min_views, min_sine, solved, found)
        for camera in range(count):
            precision, used = tiles[camera]["precision"], tiles[camera]["used"]
            for j in range(LANES):
                agrees[0, j] = precision[j] > 0.0
                agrees[1, j] = found[j] & (used[j] > 0.0)
            j = 0
            while j < last:
                t, n, joint = place[j]
                run = min(joint_count - joint, last - j)
                seen, inliers = solved.seen[t, camera, n], solved.inliers[t, camera, n]
                for k in range(run):
                    seen[joint + k], inliers[joint + k] = agrees[0, j + k], agrees[1, j + k]
                j += run


@compile_kernel
def _write_joints(
    state: State,
    place: NDArray[np.int64],
    min_views: int,
    min_sine: float,
    solved: SolvedJoints,
    found: NDArray[np.bool_],
) -> None:
    """Write the joints that their views determine, and in `found` (lanes,) which these are.

    `place` (joints, 3) has frame, person and joint of each lane, and `min_sine` is the least sine
    of the widest angle between the rays of at least `min_views` inliers.
    """
    point, matrix = state["point"], state["matrix"]
    pixels, inliers, spread = state["pixels"], state["views"], state["spread"]
    joints, covariance, error = solved.joints, solved.covariance, solved.reprojection_error
    for j in range(len(place)):
        t, n, joint = place[j]
        x, y, z = point[0, j], point[1, j], point[2, j]
        xx, xy, xz = matrix[0, j], matrix[1, j], matrix[2, j]
        yy, yz, zz = matrix[3, j], matrix[4, j], matrix[5, j]
        views, widest = inliers[j], math.sqrt(spread[j])
        found[j] = math.isfinite(x + xx) and widest >= min_sine and views >= min_views
        if found[j]:
            joints[t, n, joint] = x, y, z
            covariance[t, n, joint, 0] = xx, xy, xz
            covariance[t, n, joint, 1] = xy, yy, yz
            covariance[t, n, joint, 2] = xz, yz, zz
            solved.views[t, n, joint] = int(views)
            solved.spread[t, n, joint] = math.asin(min(1.0, widest))
            error[t, n, joint] = math.sqrt(pixels[j] / views)


@compile_kernel
def find_consensus(rig: Rig, noise: tuple[float, float], limit: float, buffers: Buffers) -> None:
    """Write the least-squares points of the inlier views, NaN where there are none.

    The first attempt uses all views. If they disagree, a Geman-McClure loss whose scale shrinks
    from the largest error to `limit` [variances] finds a majority (graduated non-convexity, Blake
    and Zisserman 1987). Without a majority, the pair of views with the smallest error over all
    views decides. The result is the plain least-squares point of the views within `limit`. The
    noise is [px], [m]; of the buffers, the tiles' `used`, the points and the inverse matrices are
    written.
    """
    tiles, state = buffers.tiles, buffers.state[0]
    for tile in tiles:
        # Start with all available views.
        tile["squared"][:] = 0.0
    _select(tiles, limit, state)
    sharpness = state["sharpness"]
    sharpness[:] = 0.0
    _start(tiles, state)
    take_step(tiles, rig.depths, noise, state)
    if _graduate(tiles, rig.depths, noise, limit, state):
        _survey(tiles, limit, state)
        for j in range(LANES):
            if sharpness[j] > 0.0:
                inside = state["inside"][j]
                # A majority of three or more agrees by chance too rarely to look further.
                if inside < 3 or 2 * inside <= state["seen"][j]:
                    _take_best_pair(rig.depths, noise, limit, j, buffers)
        sharpness[:] = 0.0
    # Updates of the inlier set; it settles after one or two.
    for _ in range(5):
        _select(tiles, limit, state)
        if not _largest(state["changed"]) > 0.0:
            break
        take_step(tiles, rig.depths, noise, state)
        take_step(tiles, rig.depths, noise, state)
    for _ in range(8):
        take_step(tiles, rig.depths, noise, state)
        # Length of a step that ends the iteration [m].
        if not _largest(state["step"]) > 1e-6**2:
            break


@compile_kernel
def _graduate(
    tiles: Tiles, depths: Floats, noise: tuple[float, float], limit: float, state: State
) -> bool:
    """Move joints whose views disagree to a majority's point; return whether there are any.

    Their loss scale ends at `limit`; the loss scale of all other joints is infinite.
    """
    _survey(tiles, limit, state)
    sharpness, most = state["sharpness"], 0.0
    for j in range(LANES):
        if state["inside"][j] < state["seen"][j]:
            worst = max(state["worst"][j], limit)
            sharpness[j] = 1.0 / worst
            most = max(most, worst)
    if most == 0.0:
        return False
    shrink = 0.1  # Factor on the scale of the loss from step to step [1].
    while True:
        take_step(tiles, depths, noise, state)
        if most <= limit:
            break
        most *= shrink
        for j in range(LANES):
            sharpness[j] = min(1.0 / limit, sharpness[j] / shrink)
    # Errors refer to the state before a step: one more step updates them.
    take_step(tiles, depths, noise, state)
    return True


@compile_kernel
def _take_best_pair(
    depths: Floats, noise: tuple[float, float], limit: float, lane: int, buffers: Buffers
) -> None:
    """Set a lane to the two-view point with the smallest truncated error over all views."""
    tiles, state = buffers.tiles, buffers.state[0]
    views = np.empty(len(tiles), np.int64)
    count = 0
    for camera in range(len(tiles)):
        if tiles[camera]["precision"][lane] > 0.0:
            views[count] = camera
            count += 1
    pairs = np.empty((LANES, 2), np.int64)
    trial, points = buffers.trial_tiles[:count], buffers.trial_state[0]
    trial_depths = depths[views[:count]]
    for k in range(count):
        _repeat_lane(tiles[views[k]], lane, trial[k])
    best, filled = math.inf, 0
    for one in range(count):
        for two in range(one + 1, count):
            pairs[filled, 0], pairs[filled, 1] = one, two
            filled += 1
            if filled < LANES and (one, two) != (count - 2, count - 1):
                continue
            for k in range(count):
                used = trial[k]["used"]
                for j in range(LANES):
                    among = j < filled and (pairs[j, 0] == k or pairs[j, 1] == k)
                    used[j] = 1.0 if among else 0.0
            points["sharpness"][:] = 0.0
            _start(trial, points)
            at = points["point"].copy()
            take_step(trial, trial_depths, noise, points)
            for j in range(filled):
                cost = 0.0
                for k in range(count):
                    squared = trial[k]["squared"][j]
                    cost += squared if squared < limit else limit
                if cost < best:
                    best = cost
                    for axis in range(3):
                        state["point"][axis, lane] = at[axis, j]
                    for k in range(count):
                        tiles[views[k]]["squared"][lane] = trial[k]["squared"][j]
            filled = 0


@compile_kernel
def _repeat_lane(tile: Tile, lane: int, trial: Tile) -> None:
    """Write one lane's observation to all lanes of another tile."""
    for k in range(4):
        trial["a"][k] = tile["a"][k, lane]
        trial["b"][k] = tile["b"][k, lane]
    trial["scale"][:] = tile["scale"][lane]
    trial["precision"][:] = tile["precision"][lane]
    trial["extra"][:] = tile["extra"][lane]


@compile_kernel
def _start(tiles: Tiles, state: State) -> None:
    """Set the points to the linear least-squares ones (inhomogeneous DLT) of the used views."""
    clear(state)
    for camera in range(len(tiles)):
        add_linear_data(tiles[camera], state)
    state["point"][:] = 0.0
    _move(state)


@compile_kernel
def take_step(tiles: Tiles, depths: Floats, noise: tuple[float, float], state: State) -> None:
    """Take one Gauss-Newton step; errors and the inverted matrix refer to the state before it."""
    clear(state)
    for camera in range(len(tiles)):
        add_data(tiles[camera], depths[camera], noise, state)
    _move(state)


@compile_kernel
def _move(state: State) -> None:
    """Add the solution of the equations to the points; the matrix becomes its inverse or NaN."""
    matrix, right, point, length = state["matrix"], state["right"], state["point"], state["step"]
    for j in range(LANES):
        a, b, c = matrix[0, j], matrix[1, j], matrix[2, j]
        d, e, f = matrix[3, j], matrix[4, j], matrix[5, j]
        p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
        determinant = a * p + b * q + c * r
        # Determinant over product of the diagonal below which rounding dominates the result [1].
        over = 1.0 / determinant if determinant > 1e-14 * a * d * f else np.nan
        matrix[0, j] = p * over
        matrix[1, j] = q * over
        matrix[2, j] = r * over
        matrix[3, j] = (a * f - c * c) * over
        matrix[4, j] = (b * c - a * e) * over
        matrix[5, j] = (a * d - b * b) * over
    for j in range(LANES):
        a, b, c = matrix[0, j], matrix[1, j], matrix[2, j]
        d, e, f = matrix[3, j], matrix[4, j], matrix[5, j]
        u, v, w = right[0, j], right[1, j], right[2, j]
        x, y, z = a * u + b * v + c * w, b * u + d * v + e * w, c * u + e * v + f * w
        point[0, j] += x
        point[1, j] += y
        point[2, j] += z
        length[j] = x * x + y * y + z * z


@compile_kernel
def _survey(tiles: Tiles, limit: float, state: State) -> None:
    """Write the number of views, the number of views within the limit, and the largest error."""
    seen, inside, worst = state["seen"], state["inside"], state["worst"]
    seen[:], inside[:], worst[:] = 0.0, 0.0, 0.0
    for camera in range(len(tiles)):
        precision, errors = tiles[camera]["precision"], tiles[camera]["squared"]
        for j in range(LANES):
            there, squared, most = precision[j] > 0.0, errors[j], worst[j]
            seen[j] += 1.0 if there else 0.0
            inside[j] += 1.0 if there & (squared <= limit) else 0.0
            worst[j] = squared if there & (squared < np.inf) & (squared > most) else most


@compile_kernel
def _select(tiles: Tiles, limit: float, state: State) -> None:
    """Mark the views within the limit as used; write the number of views that changed."""
    changed = state["changed"]
    changed[:] = 0.0
    for camera in range(len(tiles)):
        precision, errors = tiles[camera]["precision"], tiles[camera]["squared"]
        used = tiles[camera]["used"]
        for j in range(LANES):
            now = 1.0 if (precision[j] > 0.0) & (errors[j] <= limit) else 0.0
            changed[j] += (now - used[j]) * (now - used[j])
            used[j] = now


@compile_kernel
def _largest(values: Floats) -> float:
    """Return the largest value (lanes,), ignoring NaN."""
    value = 0.0
    for j in range(LANES):
        value = values[j] if values[j] > value else value
    return value


@compile_kernel
def _measure(tiles: Tiles, rig: Rig, rays: NDArray[np.void], state: State) -> None:
    """Write `pixels`, `views` and `spread` of the used views, and the rays to the points."""
    point, pixels, views, spread = state["point"], state["pixels"], state["views"], state["spread"]
    pixels[:], views[:], spread[:] = 0.0, 0.0, 1.0
    for camera in range(len(tiles)):
        a, b, inlier = tiles[camera]["a"], tiles[camera]["b"], tiles[camera]["used"]
        ray, depth, center = rays[camera]["direction"], rig.depths[camera], rig.centers[camera]
        p, q, r, s = depth[0], depth[1], depth[2], depth[3]
        cx, cy, cz = center[0], center[1], center[2]
        for j in range(LANES):
            x, y, z = point[0, j], point[1, j], point[2, j]
            inverse = 1.0 / (p * x + q * y + r * z + s)
            e = a[0, j] * x + a[1, j] * y + a[2, j] * z
            f = b[0, j] * x + b[1, j] * y + b[2, j] * z
            e, f = (e + a[3, j]) * inverse, (f + b[3, j]) * inverse
            used = inlier[j]
            pixels[j] += (e * e + f * f) * used
            views[j] += used
            x, y, z = x - cx, y - cy, z - cz
            length = 1.0 / np.sqrt(x * x + y * y + z * z)
            # A NaN ray contributes no angle.
            length = length if used > 0.0 else np.nan
            ray[0, j], ray[1, j], ray[2, j] = x * length, y * length, z * length
    for camera in range(len(tiles)):
        one = rays[camera]["direction"]
        for other in range(camera):
            two = rays[other]["direction"]
            for j in range(LANES):
                dot = one[0, j] * two[0, j]
                dot += one[1, j] * two[1, j] + one[2, j] * two[2, j]
                square, least = dot * dot, spread[j]
                spread[j] = square if square < least else least
    for j in range(LANES):
        spread[j] = 1.0 - spread[j]
