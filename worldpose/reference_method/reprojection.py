"""Triangulation: sums of squared reprojection errors, with the steps of Gauss-Newton."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from worldpose.reference_method.cameras import TensorCameras


def triangulate(
    cameras: TensorCameras, image: Tensor, start: Tensor, iterations: int = 10
) -> Tensor:
    """Return X* = arg min over X of the sum over cameras of ||Pi(X; Lambda_c) - x_c||^2 [m].

    Section "Human 3D Pose Estimation and Tracking": all views of a joint count alike. Images are
    (points, cameras, 2) [px], NaN where a point is not seen; starts (points, 3) [m], world, stay
    NaN. A point takes those of the Gauss-Newton steps that lower its error.
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
