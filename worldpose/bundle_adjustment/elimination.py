"""Compiled kernels of the reduced camera system: points are eliminated one by one.

Every point meets only the cameras that see it. With its block of the normal equations factored as
L L^T, the cameras' system loses Y^T Y, where the three rows of Y are L^-1 times the mixed block.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from worldpose.cameras.projection import project_point
from worldpose.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

STEPS = 12
"""Parameters of a camera, in the order of `worldpose.static_calibration.PARAMETERS`."""


class Evidence(NamedTuple):
    """What is known of the points, and where cameras saw them, sorted by point."""

    anchors: Floats
    """(points, 3) [m], world; where prior knowledge has them."""
    information: Floats
    """(points,) [1/m^2] of that knowledge; 0 = none, infinite = the point is fixed."""
    first_of: Integers
    """(points + 1,); observations of point p are `first_of[p]` to `first_of[p + 1]`."""
    camera_of: Integers
    """(n,)"""
    image: Floats
    """(n, 2) [px]."""
    weight: Floats
    """(n,) [1/px^2]."""
    scale: Floats
    """(n,) of Cauchy's loss, in standard deviations; infinite = plain squares."""


@compiled
def eliminate(
    cameras: Floats,
    points: Floats,
    evidence: Evidence,
    damping: float,
    first: int,
    last: int,
    rows: Floats,
    reduced: Floats,
    blocks: Floats,
    gradient: Floats,
) -> None:
    """Add the observations of points `first` to `last` to the cameras' system.

    Args:
        cameras: (cameras, 22).
        points: (points, 3) [m], world.
        evidence: of all points.
        damping: Marquardt's, of the points.
        first: of the points.
        last: exclusive.
        rows: (3 (last - first), 12 cameras), written: Y.
        reduced: (3 (last - first),), written: L^-1 times the gradient by the points.
        blocks: (cameras, 12, 12), added to; lower triangle.
        gradient: (cameras, 12), added to.
    """
    rows[:] = 0.0
    reduced[:] = 0.0
    by_camera = np.empty((2, STEPS))
    by_point = np.empty((2, 3))
    normal = np.empty(6)
    slope = np.empty(3)
    mixed = np.empty((cameras.shape[0], STEPS, 3))
    for p in range(first, last):
        known = evidence.information[p]
        start, end = evidence.first_of[p], evidence.first_of[p + 1]
        _prior(points[p], evidence.anchors[p], known, normal, slope)
        for o in range(start, end):
            c = evidence.camera_of[o]
            w, dx, dy = _observe(cameras[c], points[p], evidence, o, by_camera, by_point)
            for i in range(STEPS):
                left, right = w * by_camera[0, i], w * by_camera[1, i]
                gradient[c, i] += left * dx + right * dy
                for j in range(i + 1):
                    blocks[c, i, j] += left * by_camera[0, j] + right * by_camera[1, j]
                for j in range(3):
                    mixed[o - start, i, j] = left * by_point[0, j] + right * by_point[1, j]
            _add_point(w, dx, dy, by_point, normal, slope)
        if known == np.inf:
            continue
        a, b, c_, d, e, f = _factor(normal, damping)
        row = 3 * (p - first)
        z0 = slope[0] / a
        z1 = (slope[1] - b * z0) / c_
        reduced[row], reduced[row + 1] = z0, z1
        reduced[row + 2] = (slope[2] - d * z0 - e * z1) / f
        for o in range(start, end):
            column = STEPS * evidence.camera_of[o]
            for i in range(STEPS):
                m = mixed[o - start, i]
                y0 = m[0] / a
                y1 = (m[1] - b * y0) / c_
                rows[row, column + i] += y0
                rows[row + 1, column + i] += y1
                rows[row + 2, column + i] += (m[2] - d * y0 - e * y1) / f


@compiled
def substitute(
    cameras: Floats,
    points: Floats,
    evidence: Evidence,
    damping: float,
    steps: Floats,
    trial: Floats,
) -> None:
    """Write where the points go when the cameras step.

    Args:
        cameras: (cameras, 22), before the step.
        points: (points, 3) [m], world, before it.
        evidence: of all points.
        damping: that of the elimination.
        steps: (cameras, 12).
        trial: (points, 3) [m], written.
    """
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
            w, dx, dy = _observe(cameras[c], points[p], evidence, o, by_camera, by_point)
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


@compiled
def cost(cameras: Floats, points: Floats, evidence: Evidence) -> float:
    """Return the robust sum of squares with the points' priors; infinite where one has no image.

    Args:
        cameras: (cameras, 22).
        points: (points, 3) [m], world.
        evidence: of all points.
    """
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


@compiled
def _prior(point: Floats, anchor: Floats, known: float, normal: Floats, slope: Floats) -> None:
    """Start a point's normal equations with what is known of it beforehand."""
    normal[:] = 0.0
    slope[:] = 0.0
    if 0.0 < known < np.inf:
        normal[0] = normal[2] = normal[5] = known
        for j in range(3):
            slope[j] = known * (point[j] - anchor[j])


@compiled
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


@compiled
def _factor(normal: Floats, damping: float) -> tuple[float, float, float, float, float, float]:
    """Return the Cholesky factor by rows, the diagonal raised by the damping."""
    more = 1.0 + damping
    a = np.sqrt(more * normal[0])
    b = normal[1] / a
    c = np.sqrt(more * normal[2] - b * b)
    d = normal[3] / a
    e = (normal[4] - d * b) / c
    return a, b, c, d, e, np.sqrt(more * normal[5] - d * d - e * e)


@compiled
def _observe(
    camera: Floats,
    point: Floats,
    evidence: Evidence,
    o: int,
    by_camera: Floats,
    by_point: Floats,
) -> tuple[float, float, float]:
    """Write both Jacobians of observation `o`; return its weight and residual [px]."""
    _, xd, yd, a, b, z, dxx, dxy, dyy = project_point(camera, point[0], point[1], point[2])
    s = a * a + b * b
    for k in range(2):
        f = camera[k]
        gx, gy = (dxx, dxy) if k == 0 else (dxy, dyy)
        hx, hy = f * gx / z, f * gy / z
        hz = -(hx * a + hy * b)
        for j in range(3):
            by_point[k, j] = hx * camera[9 + j] + hy * camera[12 + j] + hz * camera[15 + j]
        d = by_camera[k]
        d[0] = b * z * hz - z * hy
        d[1] = z * hx - a * z * hz
        d[2] = a * z * hy - b * z * hx
        d[3], d[4], d[5] = hx, hy, hz
        d[6] = f * (xd if k == 0 else yd)
        d[7], d[8] = (1.0, 0.0) if k == 0 else (0.0, 1.0)
        d[9] = f * (a if k == 0 else b) * s
        d[10] = d[9] * s
        d[11] = d[10] * s
    dx = camera[0] * xd + camera[2] - evidence.image[o, 0]
    dy = camera[1] * yd + camera[3] - evidence.image[o, 1]
    weight, scale = evidence.weight[o], evidence.scale[o]
    if scale < np.inf:
        weight /= 1.0 + weight * (dx * dx + dy * dy) / (scale * scale)
    return weight, dx, dy
