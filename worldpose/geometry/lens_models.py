"""Lens models: distortion, its derivatives, its fold and its inverse, compiled.

On the plane z = 1 a lens moves the point (a, b), with s = a^2 + b^2, along its radius, and by
Brown's tangential terms off it:

    a' = a f(s) + 2 p1 a b + p2 (s + 2 a^2),
    b' = b f(s) + p1 (s + 2 b^2) + 2 p2 a b.

A lens model is its radial factor f, with the derivatives by s and by its coefficients:

    BROWN     f = 1 + k1 s + k2 s^2 + k3 s^3
    RATIONAL  f = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3), OpenCV's k1 to k6
    FISHEYE   f = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r with r = sqrt(s), t = atan(r):
              Kannala and Brandt, OpenCV's cv2.fisheye

Image radii grow with r up to the fold, where the slope of r f(r^2) vanishes. Beyond it the formula
has no meaning. Kernels take a camera as the `CameraNumbers` of its row, see `camera_model`.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats
from data_contracts.cameras import COEFFICIENTS, LENS_MODELS, LensName
from data_contracts.conventions import DISTORTION
from worldpose.compiled import compile_kernel, inline_kernel
from worldpose.geometry.rays import RayStatus
from worldpose.geometry.rigid import check_shape


class LensModel(IntEnum):
    """Radial factor of a lens."""

    BROWN = 0
    RATIONAL = 1
    FISHEYE = 2

    @classmethod
    def named(cls, name: LensName) -> LensModel:
        """Return the model of a record's name."""
        return cls[name.upper()]

    @property
    def columns(self) -> list[int]:
        """Places of the model's coefficients, in OpenCV's order, among k1 k2 p1 p2 k3 k4 k5 k6."""
        return [DISTORTION.index(name) for name in COEFFICIENTS[self.label]]

    @property
    def label(self) -> LensName:
        """Name in records."""
        return LENS_MODELS[self]


WIDTH: Final = 26
"""Numbers of a camera's row, see `camera_model`."""


class CameraNumbers(NamedTuple):
    """Numbers of a camera's row in registers: an array's references would be counted each time."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    r00: float
    r01: float
    r02: float
    r10: float
    r11: float
    r12: float
    r20: float
    r21: float
    r22: float
    tx: float
    ty: float
    tz: float
    fold: float
    k4: float
    k5: float
    k6: float
    model: float


# Radii beyond this belong to rays within a millionth of a radian of the camera's own plane.
_MAX_RADIUS = 1e6
_MAX_ITERATIONS = 100
# Largest accepted residual of an inverse on the plane z = 1: 7e-10 px at the longest focal length
# in practice, 7100 px.
_MISFIT = 1e-13


def lens_rows(distortion: Floats, model: ArrayLike = LensModel.BROWN) -> Floats:
    """Return rows (..., WIDTH) of lenses alone, with their folds; other numbers are 0.

    The distortion is (..., 5) k1 k2 p1 p2 k3 or (..., 8), then k4 k5 k6, the LensModel (...).
    """
    rows = np.zeros((*distortion.shape[:-1], WIDTH))
    rows[..., 4:9] = distortion[..., :5]
    rows[..., 22 : 17 + distortion.shape[-1]] = distortion[..., 5:]
    rows[..., 25] = model
    _write_folds(rows.reshape(-1, WIDTH))
    return rows


def fold_radius(distortion: ArrayLike) -> Floats:
    """Return the undistorted radius (...) on the plane z = 1 where Brown's model folds.

    The distortion is (..., 5) k1 k2 p1 p2 k3, or InputError. The radius is infinite without a fold
    within a radius of 1e6, NaN where a coefficient is missing.
    """
    radius: Floats = lens_rows(check_shape("fold_radius: distortion", distortion, (5,)))[..., 21]
    return radius


@inline_kernel
def load_camera(cameras: Floats, c: int) -> CameraNumbers:
    """Return the numbers of row `c`."""
    return CameraNumbers(
        cameras[c, 0],
        cameras[c, 1],
        cameras[c, 2],
        cameras[c, 3],
        cameras[c, 4],
        cameras[c, 5],
        cameras[c, 6],
        cameras[c, 7],
        cameras[c, 8],
        cameras[c, 9],
        cameras[c, 10],
        cameras[c, 11],
        cameras[c, 12],
        cameras[c, 13],
        cameras[c, 14],
        cameras[c, 15],
        cameras[c, 16],
        cameras[c, 17],
        cameras[c, 18],
        cameras[c, 19],
        cameras[c, 20],
        cameras[c, 21],
        cameras[c, 22],
        cameras[c, 23],
        cameras[c, 24],
        cameras[c, 25],
    )


@compile_kernel
def _write_folds(rows: Floats) -> None:
    for row in range(len(rows)):
        rows[row, 21] = np.sqrt(fold_squared(load_camera(rows, row)))


@compile_kernel
def fold_squared(camera: CameraNumbers) -> float:
    """Return the squared radius of the fold; infinite without one."""
    if camera.model == LensModel.BROWN.value:
        return _brown_fold_squared(camera.k1, camera.k2, camera.k3)
    # The first of a thousand rays, from the axis to its normal, that the lens does not keep in
    # order; then the interval before it is halved.
    count, high = 1024, 0.0
    for index in range(1, count + 1):
        low, high = high, min(np.tan(0.5 * np.pi * index / count), _MAX_RADIUS)
        if not _rises(camera, high):
            middle = 0.5 * (low + high)
            while low < middle < high:
                if _rises(camera, middle):
                    low = middle
                else:
                    high = middle
                middle = 0.5 * (low + high)
            break
    lens_is_known = abs(radial(camera, 0.5)[0]) < np.inf
    return high * high if lens_is_known else np.nan


@compile_kernel
def _rises(camera: CameraNumbers, radius: float) -> bool:
    """Return whether image radii are positive and grow at a radius."""
    factor, slope = radial(camera, radius * radius)
    return factor > 0.0 and factor + radius * radius * slope > 0.0


@compile_kernel
def _brown_fold_squared(k1: float, k2: float, k3: float) -> float:
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


@inline_kernel
def radial(camera: CameraNumbers, s: float) -> tuple[float, float]:
    """Return the radial factor at a squared radius, and twice its derivative by it.

    The derivative of the distorted radius r f by r is then the factor plus s times the second.
    """
    if camera.model == LensModel.BROWN.value:
        return _polynomial(s, camera.k1, camera.k2, camera.k3)
    return _radial_of_others(camera, s)


@compile_kernel
def _radial_of_others(camera: CameraNumbers, s: float) -> tuple[float, float]:
    # A function of its own, so that the compiler inlines the short way of Brown's model.
    k1, k2, k3 = camera.k1, camera.k2, camera.k3
    k4, k5, k6 = camera.k4, camera.k5, camera.k6
    if camera.model == LensModel.RATIONAL.value:
        top, by_top = _polynomial(s, k1, k2, k3)
        bottom, by_bottom = _polynomial(s, k4, k5, k6)
        return top / bottom, (by_top - top / bottom * by_bottom) / bottom
    if s < 1e-12:
        return 1.0, 2.0 * (k1 - 1.0 / 3.0)
    radius = np.sqrt(s)
    angle = np.arctan(radius)
    t = angle * angle
    factor = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) / radius
    by_angle = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    return factor, (by_angle / (1.0 + s) - factor) / s


@inline_kernel
def _polynomial(s: float, k1: float, k2: float, k3: float) -> tuple[float, float]:
    """Return 1 + k1 s + k2 s^2 + k3 s^3, and twice its derivative by s."""
    return 1.0 + s * (k1 + s * (k2 + s * k3)), 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))


@inline_kernel
def by_coefficients(
    camera: CameraNumbers, s: float
) -> tuple[float, float, float, float, float, float]:
    """Return the derivatives of the radial factor by k1 to k6."""
    if camera.model == LensModel.BROWN.value:
        return s, s * s, s * s * s, 0.0, 0.0, 0.0
    return _by_coefficients_of_others(camera, s)


@compile_kernel
def _by_coefficients_of_others(
    camera: CameraNumbers, s: float
) -> tuple[float, float, float, float, float, float]:
    if camera.model == LensModel.RATIONAL.value:
        bottom = _polynomial(s, camera.k4, camera.k5, camera.k6)[0]
        one = s / bottom
        lost = -radial(camera, s)[0] * one
        return one, one * s, one * s * s, lost, lost * s, lost * s * s
    angle = np.arctan(np.sqrt(s))
    t = angle * angle
    one = t * angle / np.sqrt(s) if s > 0.0 else 0.0
    return one, one * t, one * t * t, one * t * t * t, 0.0, 0.0


@inline_kernel
def distort(camera: CameraNumbers, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Return the distorted point and the Jacobian entries dxd/dx, dxd/dy = dyd/dx, dyd/dy."""
    factor, slope = radial(camera, x * x + y * y)
    return _bend(x, y, factor, slope, camera.p1, camera.p2)


@inline_kernel
def distort_brown(
    x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float
) -> tuple[float, float, float, float, float]:
    """Return the same as `distort` for Brown's model, without a branch: for vectorized loops."""
    factor, slope = _polynomial(x * x + y * y, k1, k2, k3)
    return _bend(x, y, factor, slope, p1, p2)


@inline_kernel
def _bend(
    x: float, y: float, factor: float, slope: float, p1: float, p2: float
) -> tuple[float, float, float, float, float]:
    s = x * x + y * y
    xd = x * factor + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    yd = y * factor + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    dxx = factor + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = factor + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, dxx, dxy, dyy


@compile_kernel
def undistort(camera: CameraNumbers, xd: float, yd: float) -> tuple[float, float, int]:
    """Return the point of the plane z = 1 whose distorted image is (xd, yd), and a RayStatus."""
    radius_d = np.sqrt(xd * xd + yd * yd)
    if not radius_d < np.inf:
        return np.nan, np.nan, RayStatus.MISSING.value
    radius, status = _undistort_radius(camera, radius_d)
    factor = radius / radius_d if radius_d > 0.0 else 1.0
    x, y = xd * factor, yd * factor
    if camera.p1 == 0.0 and camera.p2 == 0.0:
        return x, y, status
    x, y, misfit, at_fold = _polish(camera, x, y, xd, yd)
    if misfit <= _MISFIT * (1.0 + radius_d):
        return x, y, RayStatus.OK.value
    if at_fold or status == RayStatus.BEYOND_FOLD.value:
        return x, y, RayStatus.BEYOND_FOLD.value
    return x, y, RayStatus.NOT_CONVERGED.value


@compile_kernel
def _undistort_radius(camera: CameraNumbers, radius_d: float) -> tuple[float, int]:
    """Return the radius below the fold that the radial part moves to `radius_d`, and a RayStatus.

    Beyond the fold the result is a radius just inside it, a start for the tangential refinement.
    """
    low, high = 0.0, camera.fold
    if high < np.inf and radius_d >= high * radial(camera, high * high)[0]:
        return 0.99 * high, RayStatus.BEYOND_FOLD.value
    radius = min(radius_d, high)
    misfit = np.inf
    for _ in range(_MAX_ITERATIONS):
        s = radius * radius
        factor, slope = radial(camera, s)
        misfit = radius * factor - radius_d
        # Rounding of the polynomial alone leaves two units.
        if abs(misfit) <= 4.5e-16 * radius_d:
            return radius, RayStatus.OK.value
        if misfit > 0.0:
            high = radius
        else:
            low = radius
        # A Newton step that leaves the bracket is replaced by a bisection.
        following = radius - misfit / (factor + s * slope)
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if following == radius:
            break
        radius = following
    converged = abs(misfit) <= _MISFIT * (1.0 + radius_d)
    return radius, RayStatus.OK.value if converged else RayStatus.NOT_CONVERGED.value


@compile_kernel
def _polish(
    camera: CameraNumbers, x: float, y: float, xd: float, yd: float
) -> tuple[float, float, float, bool]:
    """Return the point after damped Newton steps on the full model, its residual, and the obstacle.

    A step is halved until it lowers the misfit and stays where the model is one to one; the last
    entry says whether the fold was in the way of the last step.
    """
    at = distort(camera, x, y)
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
            new = distort(camera, new_x, new_y)
            new_misfit = np.hypot(new[0] - xd, new[1] - yd)
            one_to_one = new[2] * new[4] - new[3] * new[3] > 0.0
            one_to_one = one_to_one and np.hypot(new_x, new_y) < camera.fold
            improved = one_to_one and new_misfit < misfit
            at_fold = at_fold or not one_to_one
            if improved:
                x, y, at, misfit = new_x, new_y, new, new_misfit
            size *= 0.5
        if not improved:
            break
    return x, y, misfit, at_fold
