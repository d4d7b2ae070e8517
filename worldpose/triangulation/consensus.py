"""Which views of one joint agree, and the point that suits them best.

Rows, poses and noise are those of `reprojection`; `weights` and `squared` are scratch.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled
from worldpose.triangulation.reprojection import (
    Point,
    deviations,
    linear_point,
    normal_equations,
    solve,
)

MAX_STEPS = 8
CONVERGED = 1e-9
"""Length of a step that ends the iteration [m]."""
MAX_REVISIONS = 5
"""Corrections of the set of agreeing views; it settles after one or two."""


@compiled
def refined(
    point: Point,
    rows: NDArray[np.float64],
    poses: NDArray[np.float64],
    weights: NDArray[np.float64],
    noise: tuple[float, float],
    count: int,
) -> Point:
    """Return the weighted least-squares point near `point`, by Gauss-Newton on reprojection."""
    for _ in range(MAX_STEPS):
        n, g, _ = normal_equations(point, rows, poses, weights, noise, count)
        step = solve(n, g)
        point = (point[0] + step[0], point[1] + step[1], point[2] + step[2])
        if not step[0] ** 2 + step[1] ** 2 + step[2] ** 2 > CONVERGED**2:
            break
    return point


@compiled
def graduated_point(
    point: Point,
    rows: NDArray[np.float64],
    poses: NDArray[np.float64],
    weights: NDArray[np.float64],
    noise: tuple[float, float],
    count: int,
    limit: float,
    squared: NDArray[np.float64],
) -> Point:
    """Return the point under a Geman-McClure loss of shrinking scale.

    The scale goes from the worst error to `limit`: early steps see nearly a quadratic, so that
    the start may be far away (graduated non-convexity, Blake and Zisserman 1987).
    """
    scale = limit
    for k in range(count):
        if squared[k] < math.inf:
            scale = max(scale, squared[k])
    while True:
        for k in range(count):
            weights[k] = (scale / (scale + squared[k])) ** 2 if squared[k] < math.inf else 0.0
        n, g, _ = normal_equations(point, rows, poses, weights, noise, count)
        step = solve(n, g)
        point = (point[0] + step[0], point[1] + step[1], point[2] + step[2])
        deviations(point, rows, poses, noise, count, squared)
        if scale <= limit:
            return point
        scale = max(limit, 0.25 * scale)


@compiled
def best_pair_point(
    rows: NDArray[np.float64],
    poses: NDArray[np.float64],
    weights: NDArray[np.float64],
    noise: tuple[float, float],
    count: int,
    limit: float,
    squared: NDArray[np.float64],
) -> Point:
    """Return the two-view point with the smallest truncated error over all views."""
    best, best_cost = (math.nan, math.nan, math.nan), math.inf
    for i in range(count):
        for j in range(i + 1, count):
            weights[:count] = 0.0
            weights[i] = weights[j] = 1.0
            point = linear_point(rows, poses, weights, count)
            deviations(point, rows, poses, noise, count, squared)
            cost = 0.0
            for k in range(count):
                cost += min(squared[k], limit)
            if cost < best_cost:
                best, best_cost = point, cost
    return best


@compiled
def agreeing(squared: NDArray[np.float64], count: int, limit: float) -> int:
    """Return the number of views within the limit."""
    inside = 0
    for k in range(count):
        if squared[k] <= limit:
            inside += 1
    return inside


@compiled
def consensus(
    rows: NDArray[np.float64],
    poses: NDArray[np.float64],
    noise: tuple[float, float],
    count: int,
    limit: float,
    min_views: int,
    weights: NDArray[np.float64],
    squared: NDArray[np.float64],
) -> tuple[Point, int]:
    """Return the least-squares point of the views that agree with it, and their number.

    Writes 1 for an agreeing view and 0 for another to `weights`. Number 0 = no agreement.
    """
    weights[:count] = 1.0
    point = linear_point(rows, poses, weights, count)
    point = refined(point, rows, poses, weights, noise, count)
    deviations(point, rows, poses, noise, count, squared)
    if agreeing(squared, count, limit) < count:
        point = graduated_point(point, rows, poses, weights, noise, count, limit, squared)
        inside = agreeing(squared, count, limit)
        # A majority of three or more agrees by chance too rarely to look further.
        if inside < 3 or 2 * inside <= count:
            point = best_pair_point(rows, poses, weights, noise, count, limit, squared)
            deviations(point, rows, poses, noise, count, squared)
    for _ in range(MAX_REVISIONS):
        inside, changed = 0, False
        for k in range(count):
            weight = 1.0 if squared[k] <= limit else 0.0
            changed = changed or weight != weights[k]
            weights[k] = weight
            inside += weight > 0.0
        if inside < min_views:
            return (math.nan, math.nan, math.nan), 0
        if not changed:
            break
        point = refined(point, rows, poses, weights, noise, count)
        deviations(point, rows, poses, noise, count, squared)
    return point, inside


@compiled
def spread(
    point: Point, poses: NDArray[np.float64], weights: NDArray[np.float64], count: int
) -> float:
    """Return the largest sine of an angle between two agreeing views' rays to the point."""
    rays = np.zeros((count, 3))
    largest = 0.0
    for k in range(count):
        if weights[k] <= 0.0:
            continue
        r = poses[k].reshape(3, 4)
        for i in range(3):
            y = r[i, 0] * point[0] + r[i, 1] * point[1] + r[i, 2] * point[2] + r[i, 3]
            for j in range(3):
                rays[k, j] += r[i, j] * y
        rays[k] /= math.sqrt(rays[k, 0] ** 2 + rays[k, 1] ** 2 + rays[k, 2] ** 2)
        for other in range(k):
            if weights[other] > 0.0:
                p, q = rays[k], rays[other]
                x, y, z = (
                    p[1] * q[2] - p[2] * q[1],
                    p[2] * q[0] - p[0] * q[2],
                    p[0] * q[1] - p[1] * q[0],
                )
                largest = max(largest, x * x + y * y + z * z)
    return math.sqrt(largest)
