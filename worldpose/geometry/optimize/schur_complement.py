"""Compiled kernels of the Schur complement: points are eliminated one by one.

Every point couples only the cameras that see it. With its block of the normal equations factored as
L L^T, the reduced camera system subtracts Y^T Y, where the three rows of Y are L^-1 times the mixed
block. The last column of Y is L^-1 times the gradient by the point, so Y^T Y also has the
correction of the cameras' gradient.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry.projection import distort, project_point

STEPS = 12
"""Parameters per camera, in the order of `worldpose.static_calibration.PARAMETERS`."""

_ROUNDING: Final = 1e-10
"""Share of a diagonal entry of a point's normal equations below which it is rounding error [1]:
rays that meet at an angle under 2e-5 rad."""


class Evidence(NamedTuple):
    """Priors and observations of the points, sorted by point."""

    anchors: Floats
    """(points, 3) [m], world; means of the priors."""
    information: Floats
    """(points,) [1/m^2], inverse variance of the prior; 0 = no prior, infinite = fixed point."""
    first_of: Integers
    """(points + 1,); observations of point p are `first_of[p]` to `first_of[p + 1]`."""
    camera_of: Integers
    """(n,)"""
    image: Floats
    """(n, 2) [px]."""
    weight: Floats
    """(n,) [1/px^2]."""
    scale: Floats
    """(n,) scale of Cauchy's loss, in standard deviations; infinite = squared loss."""


class CameraEquations(NamedTuple):
    """Arrays of the cameras' normal equations, which the elimination of points fills."""

    columns: Integers
    """(cameras, 12); columns of the parameters in Y, -1 = fixed parameter."""
    rows: Floats
    """(3 points, free parameters + 1): Y and, last, L^-1 times the gradient by the points."""
    blocks: Floats
    """(cameras, 12, 12); lower triangle."""
    gradient: Floats
    """(cameras, 12)"""


@compile_kernel
def eliminate(
    cameras: Floats,
    points: Floats,
    evidence: Evidence,
    damping: float,
    first: int,
    last: int,
    equations: CameraEquations,
) -> None:
    """Add the observations of points `first` to `last`, exclusive, to the cameras' system.

    `rows` of the equations is written, for these points alone, `blocks` and `gradient` are added
    to.
    """
    columns, rows = equations.columns, equations.rows
    blocks, gradient = equations.blocks, equations.gradient
    rows[:] = 0.0
    by_camera = np.empty((2, STEPS))
    by_point = np.empty((2, 3))
    normal = np.empty(6)
    slope = np.empty(3)
    mixed = np.empty((cameras.shape[0], 3, STEPS))
    for p in range(first, last):
        known = evidence.information[p]
        start, end = evidence.first_of[p], evidence.first_of[p + 1]
        _prior(points[p], evidence.anchors[p], known, normal, slope)
        for o in range(start, end):
            c = evidence.camera_of[o]
            w, dx, dy = _observe(cameras, c, points, p, evidence, o, by_camera, by_point)
            for i in range(STEPS):
                left, right = w * by_camera[0, i], w * by_camera[1, i]
                gradient[c, i] += left * dx + right * dy
                for j in range(i + 1):
                    blocks[c, i, j] += left * by_camera[0, j] + right * by_camera[1, j]
            for j in range(3):
                left, right = w * by_point[0, j], w * by_point[1, j]
                for i in range(STEPS):
                    mixed[o - start, j, i] = left * by_camera[0, i] + right * by_camera[1, i]
            _add_point(w, dx, dy, by_point, normal, slope)
        if known == np.inf:
            continue
        a, b, c_, d, e, f = _factor(normal, damping)
        row = 3 * (p - first)
        z0 = slope[0] / a
        z1 = (slope[1] - b * z0) / c_
        rows[row, -1], rows[row + 1, -1] = z0, z1
        rows[row + 2, -1] = (slope[2] - d * z0 - e * z1) / f
        for o in range(start, end):
            camera = evidence.camera_of[o]
            for i in range(STEPS):
                column = columns[camera, i]
                if column >= 0:
                    y0 = mixed[o - start, 0, i] / a
                    y1 = (mixed[o - start, 1, i] - b * y0) / c_
                    rows[row, column] += y0
                    rows[row + 1, column] += y1
                    rows[row + 2, column] += (mixed[o - start, 2, i] - d * y0 - e * y1) / f


@compile_kernel
def substitute(
    cameras: Floats,
    points: Floats,
    evidence: Evidence,
    damping: float,
    steps: Floats,
    trial: Floats,
) -> None:
    """Write the points after a step (cameras, 12) of the cameras, damped as in the elimination."""
    by_camera = np.empty((2, STEPS))
    by_point = np.empty((2, 3))
    normal = np.empty(6)
    slope = np.empty(3)
    for p in range(len(points)):
        trial[p] = points[p]
        known = evidence.information[p]
        if known == np.inf:
            continue
        _prior(points[p], evidence.anchors[p], known, normal, slope)
        for o in range(evidence.first_of[p], evidence.first_of[p + 1]):
            c = evidence.camera_of[o]
            w, dx, dy = _observe(cameras, c, points, p, evidence, o, by_camera, by_point)
            # The residual after the camera's step, to first order.
            for i in range(STEPS):
                dx += by_camera[0, i] * steps[c, i]
                dy += by_camera[1, i] * steps[c, i]
            _add_point(w, dx, dy, by_point, normal, slope)
        a, b, c_, d, e, f = _factor(normal, damping)
        z0 = -slope[0] / a
        z1 = (-slope[1] - b * z0) / c_
        z2 = (-slope[2] - d * z0 - e * z1) / f / f
        z1 = (z1 - e * z2) / c_
        trial[p, 0] += (z0 - b * z1 - d * z2) / a
        trial[p, 1] += z1
        trial[p, 2] += z2


@compile_kernel
def cost(cameras: Floats, points: Floats, evidence: Evidence) -> float:
    """Return the robust sum of squares with the points' priors; infinite if one has no image."""
    total = 0.0
    for p in range(len(points)):
        known = evidence.information[p]
        if 0.0 < known < np.inf:
            for j in range(3):
                total += known * (points[p, j] - evidence.anchors[p, j]) ** 2
        for o in range(evidence.first_of[p], evidence.first_of[p + 1]):
            camera = cameras[evidence.camera_of[o]]
            at = project_point(camera, points[p, 0], points[p, 1], points[p, 2])
            if at[0] != 0:
                return np.inf
            dx = camera[0] * at[1] + camera[2] - evidence.image[o, 0]
            dy = camera[1] * at[2] + camera[3] - evidence.image[o, 1]
            squared = evidence.weight[o] * (dx * dx + dy * dy)
            scale = evidence.scale[o]
            if scale < np.inf:
                squared = scale * scale * np.log1p(squared / (scale * scale))
            total += squared
    return total


@compile_kernel
def _prior(point: Floats, anchor: Floats, known: float, normal: Floats, slope: Floats) -> None:
    """Initialise a point's normal equations with its prior."""
    normal[:] = 0.0
    slope[:] = 0.0
    if 0.0 < known < np.inf:
        normal[0] = normal[2] = normal[5] = known
        for j in range(3):
            slope[j] = known * (point[j] - anchor[j])


@compile_kernel
def _add_point(
    w: float, dx: float, dy: float, by_point: Floats, normal: Floats, slope: Floats
) -> None:
    """Add one observation to a point's normal equations (lower triangle by rows)."""
    k = 0
    for i in range(3):
        left, right = w * by_point[0, i], w * by_point[1, i]
        slope[i] += left * dx + right * dy
        for j in range(i + 1):
            normal[k] += left * by_point[0, j] + right * by_point[1, j]
            k += 1


@compile_kernel
def _factor(normal: Floats, damping: float) -> tuple[float, float, float, float, float, float]:
    """Return the Cholesky factor by rows, the diagonal raised by the damping.

    Parallel rays leave the depth of a point to rounding; the point then does not move.
    """
    more = 1.0 + damping
    a = _pivot(more * normal[0], normal[0])
    b = normal[1] / a
    c = _pivot(more * normal[2] - b * b, normal[2])
    d = normal[3] / a
    e = (normal[4] - d * b) / c
    return a, b, c, d, e, _pivot(more * normal[5] - d * d - e * e, normal[5])


@compile_kernel
def _pivot(left: float, whole: float) -> float:
    """Return the square root of a reduced diagonal entry, at least that of its rounding error."""
    if whole <= 0.0:
        return 1.0
    return float(np.sqrt(max(left, _ROUNDING * whole)))


@compile_kernel
def _observe(
    cameras: Floats,
    c: int,
    points: Floats,
    p: int,
    evidence: Evidence,
    o: int,
    by_camera: Floats,
    by_point: Floats,
) -> tuple[float, float, float]:
    """Write both Jacobians of observation `o` of point `p`; return its weight and residual [px].

    Scalars without views of rows take a quarter of the time.
    """
    fx, fy = cameras[c, 0], cameras[c, 1]
    r00, r01, r02 = cameras[c, 9], cameras[c, 10], cameras[c, 11]
    r10, r11, r12 = cameras[c, 12], cameras[c, 13], cameras[c, 14]
    r20, r21, r22 = cameras[c, 15], cameras[c, 16], cameras[c, 17]
    px, py, pz = points[p, 0], points[p, 1], points[p, 2]
    x = r00 * px + r01 * py + r02 * pz + cameras[c, 18]
    y = r10 * px + r11 * py + r12 * pz + cameras[c, 19]
    z = r20 * px + r21 * py + r22 * pz + cameras[c, 20]
    a, b = x / z, y / z
    k1, k2, k3 = cameras[c, 4], cameras[c, 5], cameras[c, 8]
    xd, yd, dxx, dxy, dyy = distort(a, b, k1, k2, cameras[c, 6], cameras[c, 7], k3)
    # By the point in the camera's frame: g of the column, h of the row.
    gx, gy = fx * dxx / z, fx * dxy / z
    hx, hy = fy * dxy / z, fy * dyy / z
    gz, hz = -(gx * a + gy * b), -(hx * a + hy * b)
    by_point[0, 0] = gx * r00 + gy * r10 + gz * r20
    by_point[0, 1] = gx * r01 + gy * r11 + gz * r21
    by_point[0, 2] = gx * r02 + gy * r12 + gz * r22
    by_point[1, 0] = hx * r00 + hy * r10 + hz * r20
    by_point[1, 1] = hx * r01 + hy * r11 + hz * r21
    by_point[1, 2] = hx * r02 + hy * r12 + hz * r22
    by_camera[0, 0], by_camera[1, 0] = y * gz - z * gy, y * hz - z * hy
    by_camera[0, 1], by_camera[1, 1] = z * gx - x * gz, z * hx - x * hz
    by_camera[0, 2], by_camera[1, 2] = x * gy - y * gx, x * hy - y * hx
    by_camera[0, 3], by_camera[1, 3] = gx, hx
    by_camera[0, 4], by_camera[1, 4] = gy, hy
    by_camera[0, 5], by_camera[1, 5] = gz, hz
    by_camera[0, 6], by_camera[1, 6] = fx * xd, fy * yd
    by_camera[0, 7], by_camera[1, 7] = 1.0, 0.0
    by_camera[0, 8], by_camera[1, 8] = 0.0, 1.0
    s = a * a + b * b
    by_camera[0, 9], by_camera[1, 9] = fx * a * s, fy * b * s
    by_camera[0, 10], by_camera[1, 10] = fx * a * s * s, fy * b * s * s
    by_camera[0, 11], by_camera[1, 11] = fx * a * s * s * s, fy * b * s * s * s
    dx = fx * xd + cameras[c, 2] - evidence.image[o, 0]
    dy = fy * yd + cameras[c, 3] - evidence.image[o, 1]
    weight, scale = evidence.weight[o], evidence.scale[o]
    if scale < np.inf:
        weight /= 1.0 + weight * (dx * dx + dy * dy) / (scale * scale)
    return weight, dx, dy
