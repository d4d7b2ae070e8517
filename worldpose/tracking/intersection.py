"""Quick 3D joints of the tracker, from the rays of matched detections."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled
from worldpose.tracking.affinity import distance

ITERATIONS = 5
CONVERGED = 1e-3
"""Length of a step that ends the iteration [m]: a tenth of the rays' accuracy."""
FEW_RAYS = 1e-9
"""Determinant of a system with a diagonal of about 1 that counts as singular [1]."""

Point = tuple[float, float, float]


@compiled
def intersect_people(
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    weights: NDArray[np.float64],
    index: NDArray[np.int64],
    near: NDArray[np.float64],
    gate: float,
    min_sine: float,
) -> NDArray[np.float64]:
    """Return the joints of people from the rays of their detections.

    The point nearest to the rays, each weighted by `weights` over its squared length, under a
    Geman-McClure loss: a view that shows another person has little influence.

    Args:
        centers: (cameras, 3) [m], world.
        directions: (cameras, detections, joints, 3) unit rays, world; NaN where not seen.
        weights: (cameras, detections, joints), of the squared angle; 0 where not seen.
        index: (cameras, persons) index of the detection; -1 = not seen.
        near: (persons, joints, 3) [m], predicted positions; NaN without prediction.
        gate: distance [m] beyond which a ray is an outlier.
        min_sine: least sine of the angle between two inlier rays.

    Returns:
        (persons, joints, 3) [m], world; NaN with fewer than two inlier rays.
    """
    cameras, _, joint_count, _ = directions.shape
    persons = index.shape[1]
    joints = np.full((persons, joint_count, 3), np.nan)
    origin, ray = np.empty((cameras, 3)), np.empty((cameras, 3))
    weight = np.empty(cameras)
    for person in range(persons):
        for joint in range(joint_count):
            count = 0
            for c in range(cameras):
                detection = index[c, person]
                if detection >= 0 and weights[c, detection, joint] > 0.0:
                    for axis in range(3):
                        origin[count, axis] = centers[c, axis]
                        ray[count, axis] = directions[c, detection, joint, axis]
                    weight[count] = weights[c, detection, joint]
                    count += 1
            if count < 2:
                continue
            x, y, z = near[person, joint]
            scale = 0.5 * gate
            if math.isnan(x):
                x, y, z = _nearest_point(origin, ray, weight, count, (x, y, z), math.inf)
                scale *= 4.0
            for _ in range(ITERATIONS):
                u, v, w = x, y, z
                x, y, z = _nearest_point(origin, ray, weight, count, (x, y, z), scale)
                settled = scale <= 0.5 * gate
                scale = max(0.5 * gate, 0.5 * scale)
                if settled and (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2 <= CONVERGED**2:
                    break
            if _spread(origin, ray, count, (x, y, z), gate, min_sine):
                joints[person, joint, 0] = x
                joints[person, joint, 1] = y
                joints[person, joint, 2] = z
    return joints


@compiled
def _nearest_point(
    origin: NDArray[np.float64],
    ray: NDArray[np.float64],
    weight: NDArray[np.float64],
    count: int,
    point: Point,
    scale: float,
) -> Point:
    """Return the point nearest to the rays, reweighted at `point`; NaN if they are parallel."""
    a = b = c = d = e = f = g0 = g1 = g2 = total = 0.0
    for k in range(count):
        w = weight[k]
        x, y, z = ray[k, 0], ray[k, 1], ray[k, 2]
        ox, oy, oz = origin[k, 0], origin[k, 1], origin[k, 2]
        if scale < math.inf:
            away = distance(point[0], point[1], point[2], origin[k], ray[k])
            length = (point[0] - ox) ** 2 + (point[1] - oy) ** 2 + (point[2] - oz) ** 2
            w *= (scale * scale / (scale * scale + away * away)) ** 2 / length
        xx, yy, zz = w * (1.0 - x * x), w * (1.0 - y * y), w * (1.0 - z * z)
        xy, xz, yz = -w * x * y, -w * x * z, -w * y * z
        a, b, c, d, e, f = a + xx, b + xy, c + xz, d + yy, e + yz, f + zz
        g0 += xx * ox + xy * oy + xz * oz
        g1 += xy * ox + yy * oy + yz * oz
        g2 += xz * ox + yz * oy + zz * oz
        total += w
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * p + b * q + c * r
    if not determinant > FEW_RAYS * total**3:
        return (math.nan, math.nan, math.nan)
    return (
        (p * g0 + q * g1 + r * g2) / determinant,
        (q * g0 + s * g1 + t * g2) / determinant,
        (r * g0 + t * g1 + u * g2) / determinant,
    )


@compiled
def _spread(
    origin: NDArray[np.float64],
    ray: NDArray[np.float64],
    count: int,
    point: Point,
    gate: float,
    min_sine: float,
) -> bool:
    """Return whether two rays that pass within the gate are `min_sine` apart."""
    x, y, z = point
    for k in range(count):
        if not distance(x, y, z, origin[k], ray[k]) <= gate:
            continue
        for other in range(k):
            cosine = ray[k, 0] * ray[other, 0] + ray[k, 1] * ray[other, 1]
            cosine += ray[k, 2] * ray[other, 2]
            apart = 1.0 - cosine * cosine >= min_sine * min_sine
            if apart and distance(x, y, z, origin[other], ray[other]) <= gate:
                return True
    return False
