"""Compiled kernels from world points to pixels and back, over flat batches of cameras.

A camera is one row of 22 numbers: fx fy cx cy, k1 k2 p1 p2 k3, the rotation by rows, the
translation, and the radius of the fold.

Lenses have OpenCV's five coefficients k1 k2 p1 p2 k3. With s = r^2 the radial part moves radius r
to h(r) = r (1 + k1 s + k2 s^2 + k3 s^3). At the first zero of its slope h folds back; beyond it the
formula has no meaning.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats, Image
from worldpose.compiled import compile_kernel
from worldpose.geometry.rays import RayStatus
from worldpose.geometry.rigid import check_shape

# Radii beyond this belong to rays within a millionth of a radian of the camera's own plane.
_MAX_RADIUS = 1e6


def fold_radius(distortion: ArrayLike) -> Floats:
    """Return the undistorted radius on the plane z = 1 where the radial model folds.

    Args:
        distortion: (..., 5) k1 k2 p1 p2 k3.

    Returns:
        (...) radius; infinite without a fold within a radius of 1e6, NaN where a coefficient is
        missing.

    Raises:
        InputError: the last dimension is not 5.
    """
    coefficients = check_shape("fold_radius: distortion", distortion, (5,))
    squared = np.empty(coefficients.shape[:-1])
    _fold_squared(coefficients.reshape(-1, 5), squared.reshape(-1))
    return np.sqrt(squared)


@compile_kernel
def distort(
    x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float
) -> tuple[float, float, float, float, float]:
    """Return the distorted point and the Jacobian entries dxd/dx, dxd/dy = dyd/dx, dyd/dy."""
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))
    xd = x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    yd = y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    dxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, dxx, dxy, dyy


@compile_kernel
def _fold_squared(coefficients: Floats, squared: Floats) -> None:
    """Write the squared radii of the folds of lenses (batch, 5); see `fold_squared`."""
    for row in range(len(coefficients)):
        k = coefficients[row]
        squared[row] = fold_squared(k[0], k[1], k[4])


@compile_kernel
def fold_squared(k1: float, k2: float, k3: float) -> float:
    """Return the first positive root of 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3, or infinity."""
    a, b, c = 3.0 * k1, 5.0 * k2, 7.0 * k3
    if not abs(a) + abs(b) + abs(c) < np.inf:
        return np.nan
    if a >= 0.0 and b >= 0.0 and c >= 0.0:
        return np.inf
    # The slope is monotone between the roots of its own derivative a + 2 b s + 3 c s^2, so the
    # first of these intervals that ends below zero holds the first root.
    low = 0.0
    for stop in (*_turning_points(a, b, c), _MAX_RADIUS**2):
        high = min(stop, _MAX_RADIUS**2)
        if high <= low:
            continue
        if 1.0 + high * (a + high * (b + high * c)) > 0.0:
            low = high
            continue
        middle = 0.5 * (low + high)
        while low < middle < high:
            if 1.0 + middle * (a + middle * (b + middle * c)) > 0.0:
                low = middle
            else:
                high = middle
            middle = 0.5 * (low + high)
        return high
    return np.inf


@compile_kernel
def _turning_points(a: float, b: float, c: float) -> tuple[float, float]:
    """Return the positive roots of a + 2 b s + 3 c s^2 in rising order, infinity if missing."""
    discriminant = b * b - 3.0 * a * c
    if discriminant < 0.0:
        return np.inf, np.inf
    # The sum without cancellation gives one root, the product of the roots the other; either
    # division by zero means a root at infinity or none.
    total = -(b + (np.sqrt(discriminant) if b >= 0.0 else -np.sqrt(discriminant)))
    one, two = total / (3.0 * c), a / total
    first = one if one > 0.0 else np.inf
    second = two if two > 0.0 else np.inf
    return min(first, second), max(first, second)


Bytes = Image

_OK = int(RayStatus.OK)
_MISSING = int(RayStatus.MISSING)
_BEHIND = int(RayStatus.BEHIND)
_BEYOND_FOLD = int(RayStatus.BEYOND_FOLD)
_NOT_CONVERGED = int(RayStatus.NOT_CONVERGED)

_MAX_ITERATIONS = 100
# Largest accepted residual of an inverse on the plane z = 1: 7e-10 px at the longest focal length
# in practice, 7100 px.
_MISFIT = 1e-13
# Relative residual that rounding of the polynomial alone can leave: two units.


@compile_kernel
def project(cameras: Floats, points: Floats, image: Floats) -> None:
    """Write pixels of world points; NaN where a point has no image.

    Args:
        cameras: (batch, 22).
        points: (batch, n, 3) [m], world.
        image: (batch, n, 2) [px], written.
    """
    for row in range(points.shape[0]):
        c = cameras[row]
        for i in range(points.shape[1]):
            at = project_point(c, points[row, i, 0], points[row, i, 1], points[row, i, 2])
            image[row, i, 0] = c[0] * at[1] + c[2] if at[0] == _OK else np.nan
            image[row, i, 1] = c[1] * at[2] + c[3] if at[0] == _OK else np.nan


@compile_kernel
def project_with_jacobians(
    cameras: Floats, points: Floats, image: Floats, jacobian: Floats, status: Bytes
) -> None:
    """Write pixels of world points and all derivatives; NaN where a point has no image.

    Args:
        cameras: (batch, 22).
        points: (batch, n, 3) [m], world.
        image: (batch, n, 2) [px], written.
        jacobian: (batch, n, 2, 18), written: by the world point, by the left tangent update
            (rotation, translation), by fx fy cx cy, by k1 k2 p1 p2 k3.
        status: (batch, n) RayStatus, written.
    """
    for row in range(points.shape[0]):
        c = cameras[row]
        finite = is_finite(c)
        for i in range(points.shape[1]):
            code, xd, yd, a, b, z, dxx, dxy, dyy = project_point(
                c, points[row, i, 0], points[row, i, 1], points[row, i, 2]
            )
            status[row, i] = code if finite else _MISSING
            if status[row, i] != _OK:
                image[row, i] = np.nan
                jacobian[row, i] = np.nan
                continue
            image[row, i, 0] = c[0] * xd + c[2]
            image[row, i, 1] = c[1] * yd + c[3]
            s = a * a + b * b
            for k in range(2):
                f = c[k]
                # Chain rule: distorted from undistorted (g), undistorted from camera (h).
                gx, gy = (dxx, dxy) if k == 0 else (dxy, dyy)
                hx, hy = f * gx / z, f * gy / z
                hz = -(hx * a + hy * b)
                d = jacobian[row, i, k]
                for j in range(3):
                    d[j] = hx * c[9 + j] + hy * c[12 + j] + hz * c[15 + j]
                # x_cam cross h is h times -cross(x_cam), the rotation half of the update.
                d[3] = b * z * hz - z * hy
                d[4] = z * hx - a * z * hz
                d[5] = a * z * hy - b * z * hx
                d[6], d[7], d[8] = hx, hy, hz
                d[9], d[10] = (xd, 0.0) if k == 0 else (0.0, yd)
                d[11], d[12] = (1.0, 0.0) if k == 0 else (0.0, 1.0)
                here = f * (a if k == 0 else b)
                d[13] = here * s
                d[14] = here * s * s
                d[15] = f * (2.0 * a * b if k == 0 else s + 2.0 * b * b)
                d[16] = f * (s + 2.0 * a * a if k == 0 else 2.0 * a * b)
                d[17] = here * s * s * s


@compile_kernel
def normalize(cameras: Floats, image: Floats, plane: Floats, status: Bytes) -> None:
    """Write undistorted coordinates on the plane z = 1; NaN where there are none.

    Args:
        cameras: (batch, 22).
        image: (batch, n, 2) [px].
        plane: (batch, n, 2), written.
        status: (batch, n) RayStatus, written.
    """
    for row in range(image.shape[0]):
        c = cameras[row]
        finite = is_finite(c)
        for i in range(image.shape[1]):
            xd, yd = (image[row, i, 0] - c[2]) / c[0], (image[row, i, 1] - c[3]) / c[1]
            x, y, code = _undistort(c, xd, yd) if finite else (np.nan, np.nan, _MISSING)
            status[row, i] = code
            plane[row, i, 0] = x if code == _OK else np.nan
            plane[row, i, 1] = y if code == _OK else np.nan


@compile_kernel
def point_rays(cameras: Floats, plane: Floats, directions: Floats) -> None:
    """Write unit directions in the world frame through points on the plane z = 1.

    Args:
        cameras: (batch, 22).
        plane: (batch, n, 2).
        directions: (batch, n, 3), written.
    """
    for row in range(plane.shape[0]):
        c = cameras[row]
        for i in range(plane.shape[1]):
            x, y = plane[row, i, 0], plane[row, i, 1]
            scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
            for j in range(3):
                directions[row, i, j] = scale * (c[9 + j] * x + c[12 + j] * y + c[15 + j])


@compile_kernel
def is_finite(c: Floats) -> bool:
    """Return whether the camera has all parameters; its fold radius may be infinite."""
    total = 0.0
    for value in c[:-1]:
        total += abs(value)
    return total < np.inf


@compile_kernel
def project_point(
    c: Floats, px: float, py: float, pz: float
) -> tuple[int, float, float, float, float, float, float, float, float]:
    """Return status, distorted x y, undistorted x y, depth z, and the distortion's Jacobian."""
    x = c[9] * px + c[10] * py + c[11] * pz + c[18]
    y = c[12] * px + c[13] * py + c[14] * pz + c[19]
    z = c[15] * px + c[16] * py + c[17] * pz + c[20]
    a, b = x / z, y / z
    xd, yd, dxx, dxy, dyy = distort(a, b, c[4], c[5], c[6], c[7], c[8])
    status = _OK
    if not abs(x) + abs(y) + abs(z) < np.inf:
        status = _MISSING
    elif z <= 0.0:
        status = _BEHIND
    else:
        one_to_one = a * a + b * b < c[21] * c[21] and abs(xd) + abs(yd) < np.inf
        # Tangential terms deform the fold; without them the radius alone decides.
        if c[6] != 0.0 or c[7] != 0.0:
            one_to_one = one_to_one and dxx * dyy - dxy * dxy > 0.0
        if not one_to_one:
            status = _BEYOND_FOLD
    return status, xd, yd, a, b, z, dxx, dxy, dyy


@compile_kernel
def _undistort(c: Floats, xd: float, yd: float) -> tuple[float, float, int]:
    """Return the point whose distorted image is (xd, yd), and a RayStatus."""
    radius_d = np.sqrt(xd * xd + yd * yd)
    if not radius_d < np.inf:
        return np.nan, np.nan, _MISSING
    radius, status = _undistort_radius(c, radius_d)
    factor = radius / radius_d if radius_d > 0.0 else 1.0
    x, y = xd * factor, yd * factor
    if c[6] == 0.0 and c[7] == 0.0:
        return x, y, status
    x, y, misfit, at_fold = _polish(c, x, y, xd, yd)
    if misfit <= _MISFIT * (1.0 + radius_d):
        return x, y, _OK
    return x, y, _BEYOND_FOLD if at_fold or status == _BEYOND_FOLD else _NOT_CONVERGED


@compile_kernel
def _undistort_radius(c: Floats, radius_d: float) -> tuple[float, int]:
    """Return the radius below the fold that the radial part moves to `radius_d`, and a RayStatus.

    Beyond the fold the result is a radius just inside it, a start for the tangential refinement.
    """
    k1, k2, k3 = c[4], c[5], c[8]
    low, high = 0.0, c[21]
    if high < np.inf:
        s = high * high
        if radius_d >= high * (1.0 + s * (k1 + s * (k2 + s * k3))):
            return 0.99 * high, _BEYOND_FOLD
    radius = min(radius_d, high)
    misfit = np.inf
    for _ in range(_MAX_ITERATIONS):
        s = radius * radius
        misfit = radius * (1.0 + s * (k1 + s * (k2 + s * k3))) - radius_d
        # Rounding of the polynomial alone leaves two units.
        if abs(misfit) <= 4.5e-16 * radius_d:
            return radius, _OK
        if misfit > 0.0:
            high = radius
        else:
            low = radius
        # A Newton step that leaves the bracket is replaced by a bisection.
        following = radius - misfit / (1.0 + s * (3.0 * k1 + s * (5.0 * k2 + 7.0 * s * k3)))
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if following == radius:
            break
        radius = following
    return radius, _OK if abs(misfit) <= _MISFIT * (1.0 + radius_d) else _NOT_CONVERGED


@compile_kernel
def _polish(
    c: Floats, x: float, y: float, xd: float, yd: float
) -> tuple[float, float, float, bool]:
    """Return the point after damped Newton steps on the full model, its residual, and the obstacle.

    A step is halved until it lowers the misfit and stays where the model is one to one; the last
    entry says whether the fold was in the way of the last step.
    """
    at = distort(x, y, c[4], c[5], c[6], c[7], c[8])
    misfit = np.hypot(at[0] - xd, at[1] - yd)
    at_fold = False
    for _ in range(_MAX_ITERATIONS):
        determinant = at[2] * at[4] - at[3] * at[3]
        if determinant <= 0.0:
            return x, y, misfit, True
        step_x = (at[4] * (at[0] - xd) - at[3] * (at[1] - yd)) / determinant
        step_y = (at[2] * (at[1] - yd) - at[3] * (at[0] - xd)) / determinant
        size = 1.0
        improved = at_fold = False
        while size > 1e-6 and not improved:
            new_x, new_y = x - size * step_x, y - size * step_y
            new = distort(new_x, new_y, c[4], c[5], c[6], c[7], c[8])
            new_misfit = np.hypot(new[0] - xd, new[1] - yd)
            one_to_one = new[2] * new[4] - new[3] * new[3] > 0.0 and np.hypot(new_x, new_y) < c[21]
            improved = one_to_one and new_misfit < misfit
            at_fold = at_fold or not one_to_one
            if improved:
                x, y, at, misfit = new_x, new_y, new, new_misfit
            size *= 0.5
        if not improved:
            break
    return x, y, misfit, at_fold
