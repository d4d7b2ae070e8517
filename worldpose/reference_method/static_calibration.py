"""Stages 1 to 3 of a static camera (section "Static Camera Calibration")."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from data_contracts.arrays import Floats, Image
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method.cameras import K1_K2, TensorCameras
from worldpose.static_calibration.initialization import camera_from_homography, plane_from_image
from worldpose.static_calibration.parameters import project_with_jacobian, step_camera
from worldpose.static_calibration.report import StaticCalibration


def camera_from_plane(points: Floats, image: Floats, image_size: tuple[int, int]) -> Camera:
    """Return K [R | t] from the decomposition of H in x' = H x (Stage 1).

    H comes from the direct linear transformation between the image and the markings projected to a
    flat plane. K has square pixels and its principal point in the middle of the image, since a
    plane gives two equations for it.

    Args:
        points: (n, 3) [m], world; those below a metre are on the pitch.
        image: (n, 2) x [px].
        image_size: width, height [px].

    Raises:
        InputError: they determine no homography, or no camera has it.
    """
    low, size = points[:, 2] < 1.0, np.array(image_size)
    none = np.empty((0, 2)), np.empty((0, 3))
    plane, pixels = points[low, :2], image[low]
    scale, middle = 0.5 * float(np.hypot(*image_size)), 0.5 * (size - 1.0)
    found, camera = plane_from_image(pixels, plane, *none, scale, middle), None
    if found is not None and np.linalg.cond(found) < 1e12:
        span = 0.2 * image_size[0], 50.0 * image_size[0]
        back = np.asarray(np.linalg.inv(found), dtype=np.float64)
        camera = camera_from_homography(back, image_size, pixels.mean(axis=0), span)
    if camera is None:
        raise InputError(
            "method=paper, stage 1",
            expected="four clicked points on the pitch at least, no three of them on one line",
            found=f"{low.sum()} that determine no camera",
            todo="Click more points of the markings, or use method=worldpose.",
        )
    return camera


@dataclass(frozen=True, eq=False)
class _Reached:
    """A camera, Pi(X') - x (2 n,) [px], its derivatives (2 n, 11) by a step, and the cost."""

    camera: Camera
    off: Floats
    by_step: Floats
    cost: float


def refine_on_points(start: Camera, points: Floats, image: Floats) -> Camera:
    """Return Lambda* = arg min of sum ||Pi(X'; Lambda) - x||^2 (Stage 2), with k1 and k2.

    The paper names no solver: ours takes damped steps of Gauss-Newton.

    Args:
        start: of stage 1.
        points: (n, 3) X' [m], world, on the crowned pitch.
        image: (n, 2) x [px].

    Raises:
        InputError: a point lies behind the camera of stage 1.
    """

    def reach(camera: Camera) -> _Reached:
        pixels, by_step = project_with_jacobian(camera, points)
        off = (pixels - image).ravel()
        return _Reached(camera, off, by_step[..., K1_K2].reshape(len(off), -1), float(off @ off))

    def step(state: _Reached, damping: float) -> _Reached:
        normal = state.by_step.T @ state.by_step
        damped = normal + np.diag(damping * np.diag(normal))
        moved = np.linalg.solve(damped, -state.by_step.T @ state.off)
        return reach(step_camera(state.camera, np.append(moved, 0.0)))

    first = reach(start)
    if not np.isfinite(first.cost):
        raise InputError(
            "method=paper",
            expected="initial cameras that image every point that they are said to see",
            found="a point behind its camera",
            todo="Click more points of the markings, or use method=worldpose.",
        )
    course = Damping(start=1e-4, decrease=8.0, lowest=1e-12, highest=1e8)
    return minimize(
        first, step, course, 100, lambda a, b: 0.0 <= a.cost - b.cost <= 1e-9 * a.cost
    ).state.camera


def distance_map(picture: Image, camera: Camera, points: Floats) -> NDArray[np.float32]:
    """Return D (height, width), the distance to the nearest pixel of a line [px] (Stage 3).

    Supplement, "Static Camera Calibration": line pixels are Canny edges near the markings that the
    previous stage projects, of points (n, 3) [m], world, along them. The picture is (height, width)
    or (height, width, 3).
    """
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    edges = cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.0), 40, 100)
    near = np.zeros_like(grey)
    pixels = camera.project(points)
    inside = ((pixels >= 0.0) & (pixels <= camera.image_size - 1.0)).all(axis=-1)
    # Edges farther than this from the projected markings are "uninteresting lines" [px].
    near_px = 15
    for x, y in np.rint(pixels[inside]).astype(int).tolist():
        cv2.circle(near, (x, y), near_px, 255, -1)
    away = cv2.distanceTransform(255 - cv2.bitwise_and(edges, near), cv2.DIST_L2, 5)
    return np.asarray(away, dtype=np.float32)


def look_up(away: Tensor, pixels: Tensor) -> Tensor:
    """Return D[(u, v)], "by rounding the projected point (u, v) to integers" (Stage 3).

    A rounded look-up has no derivative; here it has that of D, by central differences.

    Args:
        away: (height, width) D [px].
        pixels: (n, 2) [px]; beyond the border, the nearest pixel counts.
    """
    last = pixels.new_tensor(away.shape[::-1]) - 1.0
    column, row = pixels.detach().round().clamp(torch.zeros_like(last), last).long().T
    left, top = (column - 1).clamp(min=0), (row - 1).clamp(min=0)
    right, bottom = (column + 1).clamp(max=int(last[0])), (row + 1).clamp(max=int(last[1]))
    across = (away[row, right] - away[row, left]) / (right - left)
    down = (away[bottom, column] - away[top, column]) / (bottom - top)
    slope = torch.stack([across, down], dim=-1)
    return away[row, column] + (slope * (pixels - pixels.detach())).sum(-1)


def refine_on_distance_map(start: Camera, away: NDArray[np.float32], points: Floats) -> Camera:
    """Return Lambda* = arg min over Lambda of the sum over X' of D[Pi(X'; Lambda)] (Stage 3).

    The paper names no solver: Adam takes steps of at most 1e-4 in each parameter, a fifth of a
    pixel, and the best camera of all steps is kept.

    Args:
        start: of stage 2.
        away: (height, width) D [px].
        points: (n, 3) X' [m], world, sampled from the markings; those that the start images count.
    """
    pixels = start.project(points)
    kept = ((pixels >= 0.0) & (pixels <= start.image_size - 1.0)).all(axis=-1)
    if not kept.any():
        return start
    cameras, places = TensorCameras.of(Camera.stack([start])), torch.tensor(points[kept])
    table = torch.tensor(away, dtype=torch.float64)
    values = cameras.values.clone().requires_grad_()
    solver = torch.optim.Adam([values], lr=1e-4)
    free = torch.zeros_like(values)
    free[:, list(K1_K2)] = 1.0
    best, least = cameras.values, torch.inf
    for _ in range(300):
        solver.zero_grad()
        cost = look_up(table, cameras.with_values(values).project(places)).sum()
        if float(cost.detach()) < least:
            best, least = values.detach().clone(), float(cost.detach())
        cost.backward()
        assert values.grad is not None
        values.grad *= free
        solver.step()
    return cameras.with_values(best).camera()[0]


def calibrate(
    known: StaticCalibration,
    pitch: PitchTemplate,
    picture: Image | None = None,
    start: Camera | None = None,
) -> StaticCalibration:
    """Return a calibration whose camera is that of stages 1 and 2, and with a picture of stage 3.

    Clicks that our calibration excludes count as corrected by hand. Covariance, expected ground
    error and warnings remain those of our fit: the paper has none. The picture is (height, width)
    or (height, width, 3); `start` replaces stage 1. InputError if the clicks determine no camera.
    """
    clicks = [point for point in known.report.points if point.inlier]
    points = pitch.positions([point.name for point in clicks])
    image = np.array([point.pixel for point in clicks]).reshape(-1, 2)
    width, height = known.estimate.camera.image_size.tolist()
    first = camera_from_plane(points, image, (width, height)) if start is None else start
    camera = refine_on_points(first, points, image)
    if picture is not None:
        lines = pitch.sample_lines(0.1).points_world
        camera = refine_on_distance_map(camera, distance_map(picture, camera, lines), lines)
    shown = camera.project(pitch.positions([point.name for point in known.report.points]))
    residuals = tuple(
        replace(point, residual=pixel - point.pixel)
        for point, pixel in zip(known.report.points, shown, strict=True)
    )
    stage = "points" if picture is None else "lines"
    decisions = (*known.report.decisions, "method=paper: stages 1 to 3 of the paper")
    report = replace(known.report, stage=stage, points=residuals, decisions=decisions)
    return StaticCalibration(replace(known.estimate, camera=camera), report)
