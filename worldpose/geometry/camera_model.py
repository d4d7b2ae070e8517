"""The camera model: projection and its derivatives by point, pose, focal length and lens, compiled.

A point at x, y, z [m] in camera axes meets the plane z = 1 at (a, b) = (x / z, y / z), which the
lens moves to (a', b'), see `lens_models`. Its pixel is u = fx a' + cx, v = fy b' + cy.

A camera is a row of `WIDTH` numbers: fx fy cx cy, k1 k2 p1 p2 k3, the rotation by rows, the
translation, the radius of the fold, k4 k5 k6, and the lens model. Functions of one point take it as
a tuple, see `load_camera`, and return scalars: arrays and their views would take four times as
long.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.compiled import compile_kernel, inline_kernel
from worldpose.geometry.lens_models import (
    WIDTH,
    CameraNumbers,
    by_coefficients,
    distort,
    load_camera,
    undistort,
)
from worldpose.geometry.rays import RayStatus

DERIVATIVES: Final = 21
"""Derivatives of a pixel that `project_with_jacobians` writes."""
STEP: Final = 12
"""Parameters of a camera's step: rotation about its center [rad] and shift [m] in its own axes, the
logarithm of the focal length, principal point [px], k1 k2 k3."""


@inline_kernel
def rotate(camera: CameraNumbers, wx: float, wy: float, wz: float) -> tuple[float, float, float]:
    """Return a direction of the world in camera axes."""
    x = camera.r00 * wx + camera.r01 * wy + camera.r02 * wz
    y = camera.r10 * wx + camera.r11 * wy + camera.r12 * wz
    z = camera.r20 * wx + camera.r21 * wy + camera.r22 * wz
    return x, y, z


@inline_kernel
def to_camera_axes(
    camera: CameraNumbers, px: float, py: float, pz: float
) -> tuple[float, float, float]:
    """Return a world point [m] in camera axes [m]."""
    x, y, z = rotate(camera, px, py, pz)
    return x + camera.tx, y + camera.ty, z + camera.tz


@inline_kernel
def view(
    camera: CameraNumbers, x: float, y: float, z: float
) -> tuple[int, float, float, float, float, float, float, float, float]:
    """Return the pixel of a point in camera axes, and its derivatives.

    Returns:
        RayStatus; u and v [px]; the derivatives of u, then of v, by x, y and z [px/m]. Pixel and
        derivatives are the formula's also where the status is not OK.
    """
    a, b = x / z, y / z
    xd, yd, dxx, dxy, dyy = distort(camera, a, b)
    status = RayStatus.OK.value
    if not abs(x) + abs(y) + abs(z) < np.inf:
        status = RayStatus.MISSING.value
    elif z <= 0.0:
        status = RayStatus.BEHIND.value
    else:
        fold = camera.fold
        one_to_one = a * a + b * b < fold * fold and abs(xd) + abs(yd) < np.inf
        # Tangential terms deform the fold; without them the radius alone decides.
        if camera.p1 != 0.0 or camera.p2 != 0.0:
            one_to_one = one_to_one and dxx * dyy - dxy * dxy > 0.0
        if not one_to_one:
            status = RayStatus.BEYOND_FOLD.value
    fx, fy = camera.fx, camera.fy
    gx, gy = fx * dxx / z, fx * dxy / z
    hx, hy = fy * dxy / z, fy * dyy / z
    u, v = fx * xd + camera.cx, fy * yd + camera.cy
    return status, u, v, gx, gy, -(gx * a + gy * b), hx, hy, -(hx * a + hy * b)


@inline_kernel
def by_world(camera: CameraNumbers, gx: float, gy: float, gz: float) -> tuple[float, float, float]:
    """Return derivatives by a world point from those by the point in camera axes.

    The derivatives by the camera's center are their negatives.
    """
    wx = gx * camera.r00 + gy * camera.r10 + gz * camera.r20
    wy = gx * camera.r01 + gy * camera.r11 + gz * camera.r21
    wz = gx * camera.r02 + gy * camera.r12 + gz * camera.r22
    return wx, wy, wz


@inline_kernel
def by_rotation(
    x: float, y: float, z: float, gx: float, gy: float, gz: float
) -> tuple[float, float, float]:
    """Return derivatives by a rotation vector that turns a point, from those by the point."""
    return y * gz - z * gy, z * gx - x * gz, x * gy - y * gx


@inline_kernel
def observe(
    camera: CameraNumbers, px: float, py: float, pz: float, by_step: Floats, by_point: Floats
) -> tuple[int, float, float, float]:
    """Return status, pixel u, v [px] and depth [m] of a world point, and write derivatives.

    Args:
        camera: numbers of the camera.
        px: x of the point [m], world.
        py: y.
        pz: z.
        by_step: (2, STEP) derivatives by a step of a camera with square pixels, written.
        by_point: (2, 3) derivatives by the point, written.
    """
    x, y, z = to_camera_axes(camera, px, py, pz)
    status, u, v, gx, gy, gz, hx, hy, hz = view(camera, x, y, z)
    by_point[0, 0], by_point[0, 1], by_point[0, 2] = by_world(camera, gx, gy, gz)
    by_point[1, 0], by_point[1, 1], by_point[1, 2] = by_world(camera, hx, hy, hz)
    by_step[0, 0], by_step[0, 1], by_step[0, 2] = by_rotation(x, y, z, gx, gy, gz)
    by_step[1, 0], by_step[1, 1], by_step[1, 2] = by_rotation(x, y, z, hx, hy, hz)
    by_step[0, 3], by_step[0, 4], by_step[0, 5] = gx, gy, gz
    by_step[1, 3], by_step[1, 4], by_step[1, 5] = hx, hy, hz
    by_step[0, 6], by_step[1, 6] = u - camera.cx, v - camera.cy
    by_step[0, 7], by_step[0, 8] = 1.0, 0.0
    by_step[1, 7], by_step[1, 8] = 0.0, 1.0
    a, b = x / z, y / z
    fa, fb = camera.fx * a, camera.fy * b
    k1, k2, k3, _, _, _ = by_coefficients(camera, a * a + b * b)
    by_step[0, 9], by_step[0, 10], by_step[0, 11] = fa * k1, fa * k2, fa * k3
    by_step[1, 9], by_step[1, 10], by_step[1, 11] = fb * k1, fb * k2, fb * k3
    return status, u, v, z


@inline_kernel
def project_point(
    camera: CameraNumbers, px: float, py: float, pz: float
) -> tuple[int, float, float, float]:
    """Return status, pixel u, v [px] and depth [m] of a world point [m]."""
    x, y, z = to_camera_axes(camera, px, py, pz)
    status, u, v, _, _, _, _, _, _ = view(camera, x, y, z)
    return status, u, v, z


@compile_kernel
def step_row(c: Floats, step: Floats, out: Floats) -> None:
    """Write the row (WIDTH,) of a camera `c` (WIDTH,) after a step (STEP,); its fold stays."""
    out[:] = c
    out[0] = c[0] * np.exp(step[6])
    out[1] = c[1] * np.exp(step[6])
    out[2] += step[7]
    out[3] += step[8]
    out[4] += step[9]
    out[5] += step[10]
    out[8] += step[11]
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    first = np.sin(angle) / angle if angle > 1e-12 else 1.0
    second = (1.0 - np.cos(angle)) / angle**2 if angle > 1e-6 else 0.5
    # Rodrigues' formula on every column of the rotation, and on the translation.
    for k in range(4):
        i = 18 if k == 3 else 9 + k
        s = 1 if k == 3 else 3
        x, y, z = c[i], c[i + s], c[i + 2 * s]
        cx = step[1] * z - step[2] * y
        cy = step[2] * x - step[0] * z
        cz = step[0] * y - step[1] * x
        out[i] = x + first * cx + second * (step[1] * cz - step[2] * cy)
        out[i + s] = y + first * cy + second * (step[2] * cx - step[0] * cz)
        out[i + 2 * s] = z + first * cz + second * (step[0] * cy - step[1] * cx)
    for k in range(3):
        out[18 + k] += step[3 + k]


@compile_kernel
def project(cameras: Floats, points: Floats, image: Floats) -> None:
    """Write pixels of world points; NaN where a point has no image.

    Args:
        cameras: (batch, WIDTH).
        points: (batch, n, 3) [m], world.
        image: (batch, n, 2) [px], written.
    """
    for row in range(points.shape[0]):
        camera = load_camera(cameras, row)
        for i in range(points.shape[1]):
            status, u, v, _ = project_point(
                camera, points[row, i, 0], points[row, i, 1], points[row, i, 2]
            )
            image[row, i, 0] = u if status == RayStatus.OK.value else np.nan
            image[row, i, 1] = v if status == RayStatus.OK.value else np.nan


@compile_kernel
def project_with_jacobians(
    cameras: Floats, points: Floats, image: Floats, jacobian: Floats, status: Image
) -> None:
    """Write pixels of world points and all derivatives; NaN where a point has no image.

    Args:
        cameras: (batch, WIDTH).
        points: (batch, n, 3) [m], world.
        image: (batch, n, 2) [px], written.
        jacobian: (batch, n, 2, DERIVATIVES), written: by the world point, by the left
            tangent update (rotation, translation), by fx fy cx cy, by k1 k2 p1 p2 k3 k4 k5 k6.
        status: (batch, n) RayStatus, written.
    """
    for row in range(points.shape[0]):
        finite, camera = is_finite(cameras, row), load_camera(cameras, row)
        fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
        for i in range(points.shape[1]):
            x, y, z = to_camera_axes(
                camera, points[row, i, 0], points[row, i, 1], points[row, i, 2]
            )
            code, u, v, gx, gy, gz, hx, hy, hz = view(camera, x, y, z)
            status[row, i] = code if finite else RayStatus.MISSING.value
            if status[row, i] != RayStatus.OK.value:
                image[row, i] = np.nan
                jacobian[row, i] = np.nan
                continue
            image[row, i, 0], image[row, i, 1] = u, v
            a, b = x / z, y / z
            s = a * a + b * b
            k1, k2, k3, k4, k5, k6 = by_coefficients(camera, s)
            for k in range(2):
                dx, dy, dz = (gx, gy, gz) if k == 0 else (hx, hy, hz)
                d = jacobian[row, i, k]
                d[0], d[1], d[2] = by_world(camera, dx, dy, dz)
                d[3], d[4], d[5] = by_rotation(x, y, z, dx, dy, dz)
                d[6], d[7], d[8] = dx, dy, dz
                d[9], d[10] = ((u - cx) / fx, 0.0) if k == 0 else (0.0, (v - cy) / fy)
                d[11], d[12] = (1.0, 0.0) if k == 0 else (0.0, 1.0)
                f, along = (fx, a) if k == 0 else (fy, b)
                d[13], d[14], d[17] = f * along * k1, f * along * k2, f * along * k3
                d[18], d[19], d[20] = f * along * k4, f * along * k5, f * along * k6
                d[15] = f * (2.0 * a * b if k == 0 else s + 2.0 * b * b)
                d[16] = f * (s + 2.0 * a * a if k == 0 else 2.0 * a * b)


@compile_kernel
def normalize(cameras: Floats, image: Floats, plane: Floats, status: Image) -> None:
    """Write points (x, y) on the plane z = 1 whose images are given; NaN where there are none.

    The first half of Pi^-1: distort(x, y) = ((u - cx) / fx, (v - cy) / fy).

    Args:
        cameras: (batch, WIDTH).
        image: (batch, n, 2) [px].
        plane: (batch, n, 2), written.
        status: (batch, n) RayStatus, written.
    """
    for row in range(image.shape[0]):
        finite, camera = is_finite(cameras, row), load_camera(cameras, row)
        for i in range(image.shape[1]):
            xd = (image[row, i, 0] - camera.cx) / camera.fx
            yd = (image[row, i, 1] - camera.cy) / camera.fy
            x, y, code = (
                undistort(camera, xd, yd) if finite else (np.nan, np.nan, RayStatus.MISSING.value)
            )
            status[row, i] = code
            plane[row, i, 0] = x if code == RayStatus.OK.value else np.nan
            plane[row, i, 1] = y if code == RayStatus.OK.value else np.nan


@compile_kernel
def point_rays(cameras: Floats, plane: Floats, directions: Floats) -> None:
    """Write unit directions in the world frame through points on the plane z = 1.

    The second half of Pi^-1, after `normalize`: d = R^T (x, y, 1) / |(x, y, 1)|.

    Args:
        cameras: (batch, WIDTH).
        plane: (batch, n, 2).
        directions: (batch, n, 3), written.
    """
    for row in range(plane.shape[0]):
        camera = load_camera(cameras, row)
        for i in range(plane.shape[1]):
            x, y = plane[row, i, 0], plane[row, i, 1]
            scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
            dx, dy, dz = by_world(camera, x, y, 1.0)
            directions[row, i, 0] = scale * dx
            directions[row, i, 1] = scale * dy
            directions[row, i, 2] = scale * dz


@compile_kernel
def is_finite(cameras: Floats, c: int) -> bool:
    """Return whether camera `c` has all parameters; its fold radius may be infinite."""
    total = 0.0
    for k in range(WIDTH):
        if k != 21:
            total += abs(cameras[c, k])
    return total < np.inf
