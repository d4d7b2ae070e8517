"""The tracker's own quick 3D joints: where the rays of matched detections meet."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled
from worldpose.tracking.affinity import distance

ITERATIONS = 5
FEW_RAYS = 1e-9
"""Determinant, of a system whose diagonal is about 1, that counts as singular [1]."""


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
    Geman-McClure loss: a view that shows someone else has little say.

    Args:
        centers: (cameras, 3) [m], world.
        directions: (cameras, detections, joints, 3) unit rays, world; NaN where not seen.
        weights: (cameras, detections, joints), of the squared angle; 0 where not seen.
        index: (cameras, persons) place among the detections; -1 = not seen.
        near: (persons, joints, 3) [m], expected places; NaN where there is no expectation.
        gate: distance [m] beyond which a ray does not carry the joint.
        min_sine: least sine of an angle between two carrying rays.

    Returns:
        (persons, joints, 3) [m], world; NaN where fewer than two rays agree.
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
                    origin[count], ray[count] = centers[c], directions[c, detection, joint]
                    weight[count] = weights[c, detection, joint]
                    count += 1
            if count < 2:
                continue
            point = near[person, joint].copy()
            scale = 0.5 * gate
            if math.isnan(point[0]):
                point = _nearest_point(origin, ray, weight, count, point, math.inf)
                scale *= 4.0
            for _ in range(ITERATIONS):
                point = _nearest_point(origin, ray, weight, count, point, scale)
                scale = max(0.5 * gate, 0.5 * scale)
            if _spread(origin, ray, count, point, gate) >= min_sine:
                joints[person, joint] = point
    return joints


@compiled
def _nearest_point(
    origin: NDArray[np.float64],
    ray: NDArray[np.float64],
    weight: NDArray[np.float64],
    count: int,
    point: NDArray[np.float64],
    scale: float,
) -> NDArray[np.float64]:
    """Return the point nearest to the rays, reweighted at `point`; NaN if they are parallel."""
    a = b = c = d = e = f = g0 = g1 = g2 = total = 0.0
    for k in range(count):
        w = weight[k]
        if scale < math.inf:
            away = distance(point, origin[k], ray[k])
            length = (
                (point[0] - origin[k, 0]) ** 2
                + (point[1] - origin[k, 1]) ** 2
                + (point[2] - origin[k, 2]) ** 2
            )
            w *= (scale * scale / (scale * scale + away * away)) ** 2 / length
        x, y, z = ray[k]
        xx, yy, zz = w * (1.0 - x * x), w * (1.0 - y * y), w * (1.0 - z * z)
        xy, xz, yz = -w * x * y, -w * x * z, -w * y * z
        ox, oy, oz = origin[k]
        a, b, c, d, e, f = a + xx, b + xy, c + xz, d + yy, e + yz, f + zz
        g0 += xx * ox + xy * oy + xz * oz
        g1 += xy * ox + yy * oy + yz * oz
        g2 += xz * ox + yz * oy + zz * oz
        total += w
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * p + b * q + c * r
    out = np.full(3, np.nan)
    if determinant > FEW_RAYS * total**3:
        out[0] = (p * g0 + q * g1 + r * g2) / determinant
        out[1] = (q * g0 + s * g1 + t * g2) / determinant
        out[2] = (r * g0 + t * g1 + u * g2) / determinant
    return out


@compiled
def _spread(
    origin: NDArray[np.float64],
    ray: NDArray[np.float64],
    count: int,
    point: NDArray[np.float64],
    gate: float,
) -> float:
    """Return the largest sine of an angle between two rays that pass within the gate."""
    largest = 0.0
    for k in range(count):
        if not distance(point, origin[k], ray[k]) <= gate:
            continue
        for other in range(k):
            if distance(point, origin[other], ray[other]) <= gate:
                cosine = np.dot(ray[k], ray[other])
                largest = max(largest, 1.0 - cosine * cosine)
    return math.sqrt(largest)
