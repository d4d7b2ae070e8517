"""Objective of the moving camera's fit, and its terms.

For the camera L_t of every frame t of a clip, all with one center and principal point:

    E(L) = lambda_4 E_field + lambda_5 E_player + lambda_flow E_flow + E_smooth + E_lens + E_prior

    E_field  = 1/2 sum_i rho(|W_i (Pi(X_i + d_i; L_t) - x_i)|^2)   clicks and painted lines
    E_player = 1/2 sum_i sum_j I_ij rho(|Pi(P_i; L_t) - p_j|^2 / s_j^2)   matched keypoints
    E_flow   = 1/2 sum_k rho(|Pi(Pi^-1(y_k; L_t); L_t+1) - y'_k|^2 / s_k^2)   followed points
    E_smooth = 1/2 sum_t |(l_t-1 - 2 l_t + l_t+1) / s|^2   rotation, log focal length
    E_lens   = 1/2 sum_t |(k_t+1 / s_t+1 - k_t / s_t) / w_t|^2   distortion, w_t^2 = |log f_t+1/f_t|
    E_prior  = 1/2 (center, principal point, lenses and errors d of the pitch, and the rotation
                    if camera data give it)^2 / variance

Pi is the projection and rho the Geman-McClure function; lambda_4 and lambda_5 are those of the
paper, whose supplement adds the flow and the smoothness. The paper measures residuals in pixels;
here they are in standard deviations (W_i whitens across a line, s in pixels). The errors d_i of the
pitch, the priors and E_lens are not in the paper. The distortion k of a zoom lens grows with a
power s(f) of the focal length, and departs from it by a random walk over the zoom, not over time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.clip_problem import ClipProblem
from worldpose.broadcast_calibration.evidence import (
    FlowEvidence,
    PointArrays,
    PointEvidence,
    bounds,
)
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.priors import Prior
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import STEP, by_rotation, by_world, observe, rotate, view
from worldpose.geometry.lens_models import (
    CameraNumbers,
    by_coefficients,
    distort,
    load_camera,
    undistort,
)
from worldpose.geometry.optimize.arrow import ArrowSystem
from worldpose.geometry.optimize.losses import geman_mcclure_loss, geman_mcclure_weight
from worldpose.geometry.rigid import Rigid

_MAX_LOSS: Final = 1e12
"""Loss of a point without an image, if its scale is infinite [1]."""


@dataclass(frozen=True, eq=False)
class ClipEquations:
    """The objective, half the sum of losses and squares, with matrix and gradient at a camera."""

    cost: float
    system: ArrowSystem


def linearize(camera: MovingCamera, paint_offsets: Floats, problem: ClipProblem) -> ClipEquations:
    """Return the objective, its gradient and its Gauss-Newton matrix at a camera.

    The paint has offsets (painted, 3) [standard deviations].
    """
    weights = problem.weights
    system = ArrowSystem.zeros(len(camera), FRAME_SIZE, CLIP_SIZE + paint_offsets.size)
    cost = (
        field_residuals(camera, paint_offsets, problem.field_points, weights.field, system)
        + player_residuals(camera, problem.player_points, weights.player, system)
        + flow_residuals(camera, problem.flow, problem.flow_loss, weights.flow, system)
        + smoothness_residuals(camera, problem.smoothness, system)
        + lens_residuals(camera, problem.prior, problem.lens_walk, system)
        + prior_residuals(camera, paint_offsets, problem.prior, system)
    )
    _remove_fixed(problem, system)
    return ClipEquations(float(cost), system)


def field_residuals(
    camera: MovingCamera,
    paint_offsets: Floats,
    points: PointArrays,
    weight: float,
    system: ArrowSystem,
) -> float:
    """Add weight * E_field, 1/2 sum_i rho(|W_i (Pi(X_i + d_i) - x_i)|^2), and return it."""
    return _add_points(
        camera.rows, bounds(points.frame, len(camera)), points, paint_offsets, weight, system
    )


def player_residuals(
    camera: MovingCamera, points: PointArrays, weight: float, system: ArrowSystem
) -> float:
    """Add weight * E_player, 1/2 sum_ij I_ij rho(|Pi(P_i) - p_j|^2 / s_j^2), and return it."""
    exact = np.zeros((0, 3))
    return _add_points(
        camera.rows, bounds(points.frame, len(camera)), points, exact, weight, system
    )


def flow_residuals(
    camera: MovingCamera, flow: FlowEvidence, loss: float, weight: float, system: ArrowSystem
) -> float:
    """Add weight * E_flow, 1/2 sum_k rho(|Pi(Pi^-1(y_k)) - y'_k|^2 / s_k^2), and return it."""
    if not len(flow) or weight == 0.0:
        return 0.0
    edges = bounds(flow.frame, len(camera))
    return _add_flow(camera.rows, edges, flow.start, flow.end, flow.deviation, loss, weight, system)


def smoothness_residuals(camera: MovingCamera, spread: Floats, system: ArrowSystem) -> float:
    """Add E_smooth = 1/2 sum_t |(l_t-1 - 2 l_t + l_t+1) / s|^2 to a system, and return it.

    l_t is the rotation and the log focal length of frame t.
    The derivatives assume a small rotation between neighbouring frames: a fast pan has a hundredth
    of a radian per frame. The spread (4,) of a second difference is infinite where free.
    """
    used = np.flatnonzero(np.isfinite(spread))
    if len(camera) < 3 or not len(used):
        return 0.0
    gone = second_differences(camera)[:, used] / spread[used]
    information = 1.0 / spread[used] ** 2
    count = len(camera) - 2
    factors = (1.0, -2.0, 1.0)
    for first, one in enumerate(factors):
        rows = slice(first, first + count)
        system.right[rows, used] += one * gone / spread[used]
        for second in range(first + 1):
            # The block of rows `first` and columns `second` of each triple.
            begin = slice(second, second + count)
            product = one * factors[second] * information
            system.blocks[first - second][begin, used, used] += product
    return 0.5 * float((gone**2).sum())


def second_differences(camera: MovingCamera) -> Floats:
    """Return second differences (frames - 2, 4) of rotation [rad] and log focal length."""
    turn = Rigid(
        camera.rotation[1:] @ np.swapaxes(camera.rotation[:-1], -1, -2), np.zeros(3)
    ).rotvec
    zoom = np.diff(np.log(camera.focal), n=2)[:, None]
    return np.concatenate([np.diff(turn, axis=0), zoom], axis=1)


def lens_residuals(
    camera: MovingCamera, prior: Prior, walk: Floats | None, system: ArrowSystem
) -> float:
    """Add E_lens = 1/2 sum_t |(k_t+1 / s_t+1 - k_t / s_t) / w_t|^2 to a system, and return it.

    The distortion in deviations of its prior, which grow with the zoom, changes from a frame to the
    next with the standard deviation `walk` (frames - 1,); None = free.
    """
    if walk is None:
        return 0.0
    lens = slice(FRAME_SIZE - 3, FRAME_SIZE)
    gone = np.diff(camera.distortion / prior.distortion_std, axis=0)
    gone /= walk[:, None]
    one = 1.0 / (prior.distortion_std[:-1] * walk[:, None])
    other = 1.0 / (prior.distortion_std[1:] * walk[:, None])
    numbers = np.arange(FRAME_SIZE)[lens]
    system.right[:-1, lens] -= one * gone
    system.right[1:, lens] += other * gone
    system.blocks[0][:-1, numbers, numbers] += one**2
    system.blocks[0][1:, numbers, numbers] += other**2
    system.blocks[1][:-1, numbers, numbers] -= one * other
    return 0.5 * float((gone**2).sum())


def prior_residuals(
    camera: MovingCamera, paint_offsets: Floats, prior: Prior, system: ArrowSystem
) -> float:
    """Add E_prior of center, principal point, lenses, rotation and paint to a system; return it."""
    blocks, corner = system.blocks, system.corner
    right, right_corner = system.right, system.right_corner
    paint = range(CLIP_SIZE, len(corner))
    corner[paint, paint] += 1.0
    right_corner[CLIP_SIZE:] += paint_offsets.ravel()
    off = camera.center - prior.center
    corner[:3, :3] += prior.center_information
    right_corner[:3] += prior.center_information @ off
    moved = (camera.principal_point - prior.principal_point) / prior.principal_std
    corner[[3, 4], [3, 4]] += 1.0 / prior.principal_std**2
    right_corner[3:CLIP_SIZE] += moved / prior.principal_std
    lens = np.concatenate([np.log(camera.focal)[:, None], camera.distortion], axis=1)
    middle = np.concatenate([prior.log_focal[:, None], prior.distortion], axis=1)
    width = np.broadcast_to(prior.log_focal_std, len(lens))[:, None]
    spread = np.concatenate([width, prior.distortion_std], axis=1)
    gone = (lens - middle) / spread
    blocks[0][:, range(3, FRAME_SIZE), range(3, FRAME_SIZE)] += 1.0 / spread**2
    right[:, 3:] += gone / spread
    squares = off @ prior.center_information @ off + moved @ moved
    if prior.rotation is not None and prior.rotation_std is not None:
        turn = camera.rotation @ np.swapaxes(prior.rotation, -1, -2)
        axes = Rigid(turn, np.zeros(3)).rotvec / prior.rotation_std[:, None]
        blocks[0][:, range(3), range(3)] += 1.0 / prior.rotation_std[:, None] ** 2
        right[:, :3] += axes / prior.rotation_std[:, None]
        squares += float((axes**2).sum())
    return 0.5 * float(squares + (gone**2).sum() + (paint_offsets**2).sum())


def _remove_fixed(problem: ClipProblem, system: ArrowSystem) -> None:
    """Remove fixed parameters from the system, in place."""
    blocks, border, corner = system.blocks, system.border, system.corner
    right, right_corner = system.right, system.right_corner
    fixed = problem.fixed_mask(len(right))
    if fixed.any():
        for below in range(3):
            rows = np.concatenate([fixed[below:], np.zeros((below, FRAME_SIZE), np.bool_)])
            blocks[below][rows[:, :, None] | fixed[:, None, :]] = 0.0
        border[fixed] = 0.0
        right[fixed] = 0.0
        frame, number = np.nonzero(fixed)
        blocks[0, frame, number, number] = 1.0
    held = np.flatnonzero(~problem.free_clip)
    border[:, :, held] = 0.0
    corner[held, :] = corner[:, held] = 0.0
    corner[held, held] = 1.0
    right_corner[held] = 0.0


def pixel_residuals(camera: MovingCamera, points: PointEvidence) -> Floats:
    """Return projected minus observed pixels (n, 2); infinite where there is no projection."""
    off = np.full((len(points), 2), np.inf)
    for frame in np.unique(points.frame):
        mine = np.flatnonzero(points.frame == frame)
        single = camera.frames(slice(int(frame), int(frame) + 1)).camera[0]
        off[mine] = single.project(points.world[mine]) - points.image[mine]
    return np.where(np.isfinite(off), off, np.inf)


@compile_kernel
def point_row(
    camera: CameraNumbers,
    place: Floats,
    pixel: Floats,
    row: Floats,
    by_step: Floats,
    by_point: Floats,
) -> bool:
    """Write a point's pixel (2,) and its derivatives (2, 12); return whether the pixel exists.

    Derivatives are by a frame's step, then by the clip's; `by_step` and `by_point` are room for
    `observe`.
    """
    status, pixel[0], pixel[1], depth = observe(
        camera, place[0], place[1], place[2], by_step, by_point
    )
    for k in range(2):
        row[k, 0], row[k, 1], row[k, 2] = by_step[k, 0], by_step[k, 1], by_step[k, 2]
        row[k, 3], row[k, 4] = by_step[k, 6], by_step[k, 9]
        row[k, 5], row[k, 6] = by_step[k, 10], by_step[k, 11]
        for j in range(3):
            # The derivative by the center is minus the derivative by the point.
            row[k, 7 + j] = -by_point[k, j]
        row[k, 10], row[k, 11] = by_step[k, 7], by_step[k, 8]
    # A camera in the stands sees no point within half a metre.
    return status == 0 and depth > 0.5


@compile_kernel
def displace_point(points: PointArrays, i: int, paint_offsets: Floats, place: Floats) -> None:
    """Write the place (3,) of a point with its paint errors and the pitch's size."""
    place[:] = points.world[i]
    for end in range(2):
        row = points.ends[i, end]
        if row >= 0:
            for j in range(3):
                place[j] += points.shares[i, end] * paint_offsets[row, j]
    if points.size_row >= 0:
        for kind in range(2):
            for j in range(3):
                offset = paint_offsets[points.size_row + kind, j]
                place[j] += points.by_size[i, kind, j] * offset


@compile_kernel
def displacement(points: PointArrays, i: int, one: int) -> tuple[int, float]:
    """Return the row of the paint errors, -1 = none, and a point's displacement by them.

    The number `one` is 3 * source + axis; sources are two template points, and two rows of the
    pitch's size.
    """
    source, axis = one // 3, one % 3
    if source < 2:
        return points.ends[i, source], points.shares[i, source]
    share = points.by_size[i, source - 2, axis]
    return (points.size_row + source - 2 if share != 0.0 else -1), share


@compile_kernel
def _add_points(
    cameras: Floats,
    edges: Integers,
    points: PointArrays,
    paint_offsets: Floats,
    term_weight: float,
    system: ArrowSystem,
) -> float:
    """Add points to the normal equations and return their cost, half the sum of their losses.

    Points `edges[t]` to `edges[t + 1]` belong to frame t; paint errors (painted, 3) of the
    template's points are in standard deviations.
    """
    image, whitening, loss = points.image, points.whitening, points.loss
    blocks, border, corner = system.blocks, system.border, system.corner
    right, right_corner = system.right, system.right_corner
    cost = 0.0
    pixel, rows = np.empty(2), np.empty((2, 12))
    by_step, by_point = np.empty((2, STEP)), np.empty((2, 3))
    place, moved, row_of = np.empty(3), np.empty(12), np.empty(12, dtype=np.int64)
    sources = 12 if points.size_row >= 0 else 6 if len(paint_offsets) else 0
    normal, gradient = np.empty((12, 12)), np.empty(12)
    white = np.empty(12)
    for t in range(len(cameras)):
        normal[:] = 0.0
        gradient[:] = 0.0
        camera = load_camera(cameras, t)
        for i in range(edges[t], edges[t + 1]):
            displace_point(points, i, paint_offsets, place)
            if not point_row(camera, place, pixel, rows, by_step, by_point):
                cost += 0.5 * term_weight * min(loss[i] * loss[i], _MAX_LOSS)
                continue
            u, v = pixel[0] - image[i, 0], pixel[1] - image[i, 1]
            squared = 0.0
            for axis in range(2):
                e = whitening[i, axis, 0] * u + whitening[i, axis, 1] * v
                squared += e * e
            cost += 0.5 * term_weight * geman_mcclure_loss(squared, loss[i])
            factor = term_weight * geman_mcclure_weight(squared, loss[i])
            for axis in range(2):
                p, q = whitening[i, axis, 0], whitening[i, axis, 1]
                if p == 0.0 and q == 0.0:
                    continue
                e = p * u + q * v
                for j in range(12):
                    white[j] = p * rows[0, j] + q * rows[1, j]
                for j in range(12):
                    value = factor * white[j]
                    gradient[j] += value * e
                    for m in range(j + 1):
                        normal[j, m] += value * white[m]
                for one in range(sources):
                    first, share = displacement(points, i, one)
                    moved[one] = -white[7 + one % 3] * share
                    row_of[one] = -1 if first < 0 else 5 + 3 * first + one % 3
                for one in range(sources):
                    row = row_of[one]
                    if row < 0:
                        continue
                    value = factor * moved[one]
                    right_corner[row] += value * e
                    for j in range(7):
                        border[t, j, row] += value * white[j]
                    for j in range(5):
                        corner[row, j] += value * white[7 + j]
                        corner[j, row] += value * white[7 + j]
                    for other in range(sources):
                        if row_of[other] >= 0:
                            corner[row, row_of[other]] += value * moved[other]
        for j in range(7):
            right[t, j] += gradient[j]
            for m in range(j + 1):
                blocks[0, t, j, m] += normal[j, m]
                if m < j:
                    blocks[0, t, m, j] += normal[j, m]
            for m in range(5):
                border[t, j, m] += normal[7 + m, j]
        for j in range(5):
            right_corner[j] += gradient[7 + j]
            for m in range(j + 1):
                corner[j, m] += normal[7 + j, 7 + m]
                if m < j:
                    corner[m, j] += normal[7 + j, 7 + m]
    return cost


@compile_kernel
def flow_row(
    before: CameraNumbers,
    after: CameraNumbers,
    start_u: float,
    start_v: float,
    pixel: Floats,
    row: Floats,
) -> bool:
    """Write the pixel in the second of two frames of a point in the first, and derivatives (2, 16).

    The point is a direction from the center, which both frames share. Derivatives are by the first
    frame's step, the second's, and the principal point. Return whether the pixel exists.
    """
    focal = before.fx
    xd, yd = (start_u - before.cx) / focal, (start_v - before.cy) / focal
    a, b, status = undistort(before, xd, yd)
    if status != 0:
        return False
    wx, wy, wz = by_world(before, a, b, 1.0)
    x, y, z = rotate(after, wx, wy, wz)
    status, pixel[0], pixel[1], gx, gy, gz, hx, hy, hz = view(after, x, y, z)
    if status != 0:
        return False
    _, _, dxx, dxy, dyy = distort(before, a, b)
    determinant = dxx * dyy - dxy * dxy
    k1, k2, k3, _, _, _ = by_coefficients(before, a * a + b * b)
    c, d = x / z, y / z
    n1, n2, n3, _, _, _ = by_coefficients(after, c * c + d * d)
    for k in range(2):
        dx, dy, dz = (gx, gy, gz) if k == 0 else (hx, hy, hz)
        # By the direction in the first camera's axes, then by its distorted point.
        ox, oy, oz = by_world(after, dx, dy, dz)
        ha, hb, hc = rotate(before, ox, oy, oz)
        pa, pb = (dyy * ha - dxy * hb) / determinant, (dxx * hb - dxy * ha) / determinant
        r1, r2, r3 = by_rotation(a, b, 1.0, ha, hb, hc)
        row[k, 0], row[k, 1], row[k, 2] = -r1, -r2, -r3
        row[k, 3] = -(pa * xd + pb * yd)
        along = -(pa * a + pb * b)
        row[k, 4], row[k, 5], row[k, 6] = along * k1, along * k2, along * k3
        row[k, 7], row[k, 8], row[k, 9] = by_rotation(x, y, z, dx, dy, dz)
        row[k, 10] = pixel[k] - (after.cx if k == 0 else after.cy)
        along = after.fx * c if k == 0 else after.fy * d
        row[k, 11], row[k, 12], row[k, 13] = along * n1, along * n2, along * n3
        row[k, 14] = (1.0 if k == 0 else 0.0) - pa / focal
        row[k, 15] = (0.0 if k == 0 else 1.0) - pb / focal
    return True


@compile_kernel
def _add_flow(
    cameras: Floats,
    edges: Integers,
    start: Floats,
    end: Floats,
    deviation: Floats,
    loss: float,
    term_weight: float,
    system: ArrowSystem,
) -> float:
    """Add followed points from frame t, `edges[t]` to `edges[t + 1]`, and return their cost."""
    blocks, border, corner = system.blocks, system.border, system.corner
    right, right_corner = system.right, system.right_corner
    cost = 0.0
    pixel, rows = np.empty(2), np.empty((2, 16))
    normal, gradient = np.empty((16, 16)), np.empty(16)
    for t in range(len(cameras) - 1):
        if edges[t] == edges[t + 1]:
            continue
        normal[:] = 0.0
        gradient[:] = 0.0
        before, after = load_camera(cameras, t), load_camera(cameras, t + 1)
        for i in range(edges[t], edges[t + 1]):
            if not flow_row(before, after, start[i, 0], start[i, 1], pixel, rows):
                cost += 0.5 * term_weight * min(loss * loss, _MAX_LOSS)
                continue
            scale = 1.0 / deviation[i]
            u, v = scale * (pixel[0] - end[i, 0]), scale * (pixel[1] - end[i, 1])
            squared = u * u + v * v
            cost += 0.5 * term_weight * geman_mcclure_loss(squared, loss)
            factor = term_weight * geman_mcclure_weight(squared, loss) * scale
            for j in range(16):
                p, q = factor * rows[0, j], factor * rows[1, j]
                gradient[j] += p * u + q * v
                p, q = scale * p, scale * q
                for m in range(j + 1):
                    normal[j, m] += p * rows[0, m] + q * rows[1, m]
        for j in range(7):
            right[t, j] += gradient[j]
            right[t + 1, j] += gradient[7 + j]
            for m in range(7):
                high, low = max(j, m), min(j, m)
                blocks[0, t, j, m] += normal[high, low]
                blocks[0, t + 1, j, m] += normal[7 + high, 7 + low]
                blocks[1, t, j, m] += normal[7 + j, m]
            for m in range(2):
                border[t, j, 3 + m] += normal[14 + m, j]
                border[t + 1, j, 3 + m] += normal[14 + m, 7 + j]
        for j in range(2):
            right_corner[3 + j] += gradient[14 + j]
            for m in range(2):
                corner[3 + j, 3 + m] += normal[14 + max(j, m), 14 + min(j, m)]
    return cost
