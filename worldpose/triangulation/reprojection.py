"""Reprojection of one joint into its views: errors, normal equations, linear start.

Observations of a joint are rows `u, v, m00, m01, m10, m11, confidence`: the undistorted
coordinates on the plane z = 1 and the matrix that turns differences there into pixels. Cameras
are rows of the 3x4 matrix cam_from_world. Symmetric matrices are their entries xx xy xz yy yz zz.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled

Point = tuple[float, float, float]
Symmetric = tuple[float, float, float, float, float, float]

SINGULAR = 1e-14
"""Determinant over product of the diagonal below which rounding decides the answer [1]."""


@compiled
def inverse(n: Symmetric) -> Symmetric:
    """Return the inverse of a symmetric matrix, NaN where it is singular to working precision."""
    a, b, c, d, e, f = n
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * p + b * q + c * r
    if not determinant > SINGULAR * a * d * f:
        determinant = math.nan
    return (
        p / determinant,
        q / determinant,
        r / determinant,
        (a * f - c * c) / determinant,
        (b * c - a * e) / determinant,
        (a * d - b * b) / determinant,
    )


@compiled
def solve(n: Symmetric, g: Point) -> Point:
    """Return the solution of a symmetric system, NaN where it is singular."""
    a, b, c, d, e, f = inverse(n)
    return (
        a * g[0] + b * g[1] + c * g[2],
        b * g[0] + d * g[1] + e * g[2],
        c * g[0] + e * g[1] + f * g[2],
    )


@compiled
def linear_point(
    rows: NDArray[np.float64], poses: NDArray[np.float64], weights: NDArray[np.float64], count: int
) -> Point:
    """Return the weighted linear least-squares point (inhomogeneous DLT) of the views."""
    a = b = c = d = e = f = g0 = g1 = g2 = 0.0
    for k in range(count):
        w = weights[k] * abs(rows[k, 2] * rows[k, 5])
        if w <= 0.0:
            continue
        pose = poses[k]
        for axis in range(2):
            s, o = rows[k, axis], 4 * axis
            x, y = s * pose[8] - pose[o], s * pose[9] - pose[o + 1]
            z, r = s * pose[10] - pose[o + 2], s * pose[11] - pose[o + 3]
            a += w * x * x
            b += w * x * y
            c += w * x * z
            d += w * y * y
            e += w * y * z
            f += w * z * z
            g0 -= w * x * r
            g1 -= w * y * r
            g2 -= w * z * r
    return solve((a, b, c, d, e, f), (g0, g1, g2))


@compiled
def deviations(
    point: Point,
    rows: NDArray[np.float64],
    poses: NDArray[np.float64],
    noise: tuple[float, float],
    count: int,
    out: NDArray[np.float64],
) -> None:
    """Write the squared reprojection error of each view in units of its variance to `out`.

    Infinity where the point is behind the camera.
    """
    for k in range(count):
        pose = poses[k]
        z = pose[8] * point[0] + pose[9] * point[1] + pose[10] * point[2] + pose[11]
        if not z > 0.0:
            out[k] = math.inf
            continue
        du = (pose[0] * point[0] + pose[1] * point[1] + pose[2] * point[2] + pose[3]) / z
        dv = (pose[4] * point[0] + pose[5] * point[1] + pose[6] * point[2] + pose[7]) / z
        du -= rows[k, 0]
        dv -= rows[k, 1]
        e0 = rows[k, 2] * du + rows[k, 3] * dv
        e1 = rows[k, 4] * du + rows[k, 5] * dv
        scale = (rows[k, 2] * rows[k, 5] - rows[k, 3] * rows[k, 4]) / (z * z)
        variance = (noise[0] ** 2 + abs(scale) * noise[1] ** 2) / rows[k, 6]
        out[k] = (e0 * e0 + e1 * e1) / variance


@compiled
def normal_equations(
    point: Point,
    rows: NDArray[np.float64],
    poses: NDArray[np.float64],
    weights: NDArray[np.float64],
    noise: tuple[float, float],
    count: int,
) -> tuple[Symmetric, Point, float]:
    """Return the Gauss-Newton matrix, its right side and the weighted squared pixel error."""
    a = b = c = d = e = f = g0 = g1 = g2 = squares = 0.0
    for k in range(count):
        if weights[k] <= 0.0:
            continue
        pose = poses[k]
        z = pose[8] * point[0] + pose[9] * point[1] + pose[10] * point[2] + pose[11]
        if not z > 0.0:
            continue
        u = (pose[0] * point[0] + pose[1] * point[1] + pose[2] * point[2] + pose[3]) / z
        v = (pose[4] * point[0] + pose[5] * point[1] + pose[6] * point[2] + pose[7]) / z
        ux, uy = (pose[0] - u * pose[8]) / z, (pose[1] - u * pose[9]) / z
        uz = (pose[2] - u * pose[10]) / z
        vx, vy = (pose[4] - v * pose[8]) / z, (pose[5] - v * pose[9]) / z
        vz = (pose[6] - v * pose[10]) / z
        m00, m01, m10, m11 = rows[k, 2], rows[k, 3], rows[k, 4], rows[k, 5]
        scale = abs(m00 * m11 - m01 * m10) / (z * z)
        w = weights[k] * rows[k, 6] / (noise[0] ** 2 + scale * noise[1] ** 2)
        du, dv = u - rows[k, 0], v - rows[k, 1]
        for axis in range(2):
            p, q = (m00, m01) if axis == 0 else (m10, m11)
            x, y, s = p * ux + q * vx, p * uy + q * vy, p * uz + q * vz
            error = p * du + q * dv
            squares += weights[k] * error * error
            a += w * x * x
            b += w * x * y
            c += w * x * s
            d += w * y * y
            e += w * y * s
            f += w * s * s
            g0 -= w * x * error
            g1 -= w * y * error
            g2 -= w * s * error
    return (a, b, c, d, e, f), (g0, g1, g2), squares
