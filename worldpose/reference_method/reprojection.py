"""Stage 2, triangulation and bundle adjustment: sums of squared reprojection errors.

The paper names no solver: steps are those of Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from worldpose.errors import InputError
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.reference_method.cameras import PARAMETERS, TensorCameras, project


class Views(NamedTuple):
    """Points seen in cameras: I of the paper, one row per visible point and camera."""

    point: Tensor
    """(n,) index of the point."""
    camera: Tensor
    """(n,) index of the camera."""
    image: Tensor
    """(n, 2) x [px]."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Cameras and points (points, 3) [m] with the sum of squared errors [px^2]."""

    cameras: TensorCameras
    points: Tensor
    cost: float


def reprojection_error(cameras: TensorCameras, points: Tensor, seen: Views) -> Tensor:
    """Return sum of I ||Pi(X; Lambda) - x||^2 [px^2]; infinite with a point behind its camera.

    Equations of Stage 2 and of "Bundle Adjustment".
    """
    off = cameras.project(points[seen.point], seen.camera) - seen.image
    return off.square().sum().nan_to_num(torch.inf)


def minimize_reprojection(
    cameras: TensorCameras,
    points: Tensor,
    seen: Views,
    moving: Tensor,
    free: Sequence[int],
    iterations: int = 100,
) -> Adjusted:
    """Return arg min over Lambda_c and P of `reprojection_error`, without prior or validation.

    Section "Bundle Adjustment". On S alone no point moves, as in Stage 2.

    Args:
        cameras: the start.
        points: (points, 3) [m], world: field markings S and people's joints P.
        seen: what each camera sees.
        moving: (points,) bool: P moves, and S stays as surveyed.
        free: parameters of a camera that move, of `PARAMETERS`.
        iterations: maximum number of steps.

    Raises:
        InputError: a point lies behind the initial camera that sees it.
    """

    def step(state: Adjusted, damping: float) -> Adjusted:
        by_camera, by_point = _gauss_newton_step(state, seen, moving, free, damping)
        moved = state.cameras.with_values(state.cameras.values + by_camera)
        places = state.points + by_point
        return Adjusted(moved, places, float(reprojection_error(moved, places, seen)))

    start = Adjusted(cameras, points, float(reprojection_error(cameras, points, seen)))
    if start.cost == torch.inf:
        raise InputError(
            "method=paper",
            expected="initial cameras that image every point that they are said to see",
            found="a point behind its camera",
            todo="Click more points of the markings, or use method=worldpose.",
        )
    course = Damping(start=1e-4, decrease=8.0, lowest=1e-12, highest=1e8)
    return minimize(
        start, step, course, iterations, lambda a, b: 0.0 <= a.cost - b.cost <= 1e-9 * a.cost
    ).state


def _gauss_newton_step(
    state: Adjusted, seen: Views, moving: Tensor, free: Sequence[int], damping: float
) -> tuple[Tensor, Tensor]:
    """Return the damped steps (cameras, 12) and (points, 3); points are eliminated first."""
    cameras, points = state.cameras, state.points
    count, size = len(cameras.values), len(points)
    own = (cameras.values[seen.camera], cameras.rotation[seen.camera], cameras.aspect[seen.camera])
    off = project(points[seen.point], *own) - seen.image
    by_point, by_values = vmap(jacrev(project, argnums=(0, 1)))(points[seen.point], *own)
    by_point = by_point * moving[seen.point, None, None]
    mask = torch.zeros(PARAMETERS, dtype=points.dtype)
    mask[list(free)] = 1.0
    by_values = by_values * mask

    def add(index: Tensor, rows: int, values: Tensor) -> Tensor:
        return values.new_zeros(rows, *values.shape[1:]).index_add(0, index, values)

    def damp(blocks: Tensor) -> Tensor:
        diagonal = blocks.diagonal(dim1=-2, dim2=-1)
        # A fixed unknown has no information, and takes no step with any.
        return blocks + torch.diag_embed(torch.where(diagonal > 0.0, damping * diagonal, 1.0))

    of_camera = damp(add(seen.camera, count, by_values.mT @ by_values))
    factor = torch.linalg.cholesky(damp(add(seen.point, size, by_point.mT @ by_point)))
    slope = add(seen.camera, count, (by_values.mT @ off[..., None])[..., 0])
    pull = add(seen.point, size, (by_point.mT @ off[..., None])[..., 0])
    mixed = points.new_zeros(size, count, 3, PARAMETERS)
    mixed = mixed.index_put((seen.point, seen.camera), by_point.mT @ by_values, accumulate=True)
    mixed = mixed.transpose(1, 2).reshape(size, 3, count * PARAMETERS)
    right = torch.cat([mixed, pull[..., None]], dim=-1)
    reduced = torch.linalg.solve_triangular(factor, right, upper=False).reshape(3 * size, -1)
    outer = reduced[:, :-1].T @ reduced
    system = torch.block_diag(*of_camera) - outer[:, :-1]
    step = -torch.linalg.solve(system, slope.flatten() - outer[:, -1])
    back = torch.cholesky_solve((pull + mixed @ step)[..., None], factor)[..., 0]
    return step.reshape(count, PARAMETERS), -back


def triangulate(
    cameras: TensorCameras, image: Tensor, start: Tensor, iterations: int = 10
) -> Tensor:
    """Return X* = arg min over X of the sum over cameras of ||Pi(X; Lambda_c) - x_c||^2 [m].

    Section "Human 3D Pose Estimation and Tracking": all views of a joint count alike.

    Args:
        cameras: (cameras,).
        image: (points, cameras, 2) [px]; NaN where a point is not seen.
        start: (points, 3) [m], world; NaN stays NaN.
        iterations: number of Gauss-Newton steps; a point takes those that lower its error.
    """

    def residuals(point: Tensor, pixels: Tensor) -> Tensor:
        return torch.where(torch.isfinite(pixels), cameras.project(point) - pixels, 0.0).flatten()

    points, every = start.clone(), vmap(residuals)
    for _ in range(iterations):
        off, slope = every(points, image), vmap(jacrev(residuals))(points, image)
        step = torch.linalg.pinv(slope.nan_to_num(0.0)) @ off.nan_to_num(0.0)[..., None]
        trial = points - step[..., 0]
        better = every(trial, image).square().sum(1) < off.square().sum(1)
        points = torch.where(better[:, None], trial, points)
    return points


def triangulate_about_mid_hip(
    cameras: TensorCameras, image: Tensor, start: Tensor, mid_hip_image: Tensor, mid_hip: Tensor
) -> Tensor:
    """Return X* = arg min ||(Pi(X) - Pi(X_midhip)) - (x - x_midhip)||^2 [m].

    Supplement, "Estimating 3D Skeletons": the mid-hips are triangulated first, and then the other
    joints with the 2D mid-hips moved onto the projected 3D ones.

    Args:
        cameras: (cameras,).
        image: (persons, joints, cameras, 2) x [px]; NaN where a joint is not seen.
        start: (persons, joints, 3) [m], world.
        mid_hip_image: (persons, cameras, 2) x_midhip [px]; NaN where it is not seen.
        mid_hip: (persons, 3) X_midhip [m], world.
    """
    moved = image + (cameras.project(mid_hip[:, None]) - mid_hip_image)[:, None]
    return triangulate(cameras, moved.flatten(0, 1), start.flatten(0, 1)).reshape(start.shape)
