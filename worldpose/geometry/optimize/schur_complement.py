"""Compiled kernels of the Schur complement: points are eliminated one by one.

Every point couples only the cameras that see it. With its block of the normal equations factored as
L L^T, the reduced camera system subtracts Y^T Y, where the three rows of Y are L^-1 times the mixed
block. The last column of Y is L^-1 times the gradient by the point, so Y^T Y also has the
correction of the cameras' gradient.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import STEP, observe, project_point
from worldpose.geometry.lens_models import load_camera
from worldpose.geometry.optimize.losses import cauchy_loss, cauchy_weight


class PointObservations(NamedTuple):
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
    observed: PointObservations,
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
    by_camera = np.empty((2, STEP))
    by_point = np.empty((2, 3))
    normal = np.empty(6)
    slope = np.empty(3)
    mixed = np.empty((cameras.shape[0], 3, STEP))
    for p in range(first, last):
        known = observed.information[p]
        start, end = observed.first_of[p], observed.first_of[p + 1]
        _prior(points[p], observed.anchors[p], known, normal, slope)
        for o in range(start, end):
            c = observed.camera_of[o]
            w, dx, dy = _observe(cameras, points, p, observed, o, by_camera, by_point)
            for i in range(STEP):
                left, right = w * by_camera[0, i], w * by_camera[1, i]
                gradient[c, i] += left * dx + right * dy
                for j in range(i + 1):
                    blocks[c, i, j] += left * by_camera[0, j] + right * by_camera[1, j]
            for j in range(3):
                left, right = w * by_point[0, j], w * by_point[1, j]
                for i in range(STEP):
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
            camera = observed.camera_of[o]
            for i in range(STEP):
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
    observed: PointObservations,
    damping: float,
    steps: Floats,
    trial: Floats,
) -> None:
    """Write the points after a step (cameras, 12) of the cameras, damped as in the elimination."""
    by_camera = np.empty((2, STEP))
    by_point = np.empty((2, 3))
    normal = np.empty(6)
    slope = np.empty(3)
    for p in range(len(points)):
        trial[p] = points[p]
        known = observed.information[p]
        if known == np.inf:
            continue
        _prior(points[p], observed.anchors[p], known, normal, slope)
        for o in range(observed.first_of[p], observed.first_of[p + 1]):
            c = observed.camera_of[o]
            w, dx, dy = _observe(cameras, points, p, observed, o, by_camera, by_point)
            # The residual after the camera's step, to first order.
            for i in range(STEP):
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
def cost(cameras: Floats, points: Floats, observed: PointObservations) -> float:
    """Return the robust sum of squares with the points' priors; infinite if one has no image."""
    total = 0.0
    for p in range(len(points)):
        known = observed.information[p]
        if 0.0 < known < np.inf:
            for j in range(3):
                total += known * (points[p, j] - observed.anchors[p, j]) ** 2
        for o in range(observed.first_of[p], observed.first_of[p + 1]):
            camera = load_camera(cameras, observed.camera_of[o])
            status, u, v, _ = project_point(camera, points[p, 0], points[p, 1], points[p, 2])
            if status != 0:
                return np.inf
            dx, dy = u - observed.image[o, 0], v - observed.image[o, 1]
            total += cauchy_loss(observed.weight[o] * (dx * dx + dy * dy), observed.scale[o])
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
    # Share of a diagonal entry of a point's normal equations below which it is rounding error
    # [1]: rays that meet at an angle under 2e-5 rad.
    rounding = 1e-10
    if whole <= 0.0:
        return 1.0
    return float(np.sqrt(max(left, rounding * whole)))


@compile_kernel
def _observe(
    cameras: Floats,
    points: Floats,
    p: int,
    observed: PointObservations,
    o: int,
    by_camera: Floats,
    by_point: Floats,
) -> tuple[float, float, float]:
    """Write both Jacobians of observation `o` of point `p`; return its weight and residual [px]."""
    _, u, v, _ = observe(
        load_camera(cameras, observed.camera_of[o]),
        points[p, 0],
        points[p, 1],
        points[p, 2],
        by_camera,
        by_point,
    )
    dx, dy = u - observed.image[o, 0], v - observed.image[o, 1]
    weight = observed.weight[o]
    return weight * cauchy_weight(weight * (dx * dx + dy * dy), observed.scale[o]), dx, dy
