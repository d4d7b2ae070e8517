"""Lens distortion with OpenCV's five coefficients k1 k2 p1 p2 k3, and the radius where it folds.

With s = r^2 the radial part moves radius r to h(r) = r (1 + k1 s + k2 s^2 + k3 s^3). At the first
zero of its slope h folds back; beyond it the formula has no meaning.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from worldpose.compiled import compile_kernel
from worldpose.geometry.rigid import check_shape

# Radii beyond this belong to rays within a millionth of a radian of the camera's own plane.
_MAX_RADIUS = 1e6


def fold_radius(distortion: ArrayLike) -> NDArray[np.float64]:
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
def _fold_squared(coefficients: NDArray[np.float64], squared: NDArray[np.float64]) -> None:
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
