"""Compiled cost and normal equations of followed points between neighbouring frames (M6)."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.normal_equations import direction_row
from worldpose.compiled import compiled

_UNDISTORT: Final = 30
"""Maximum Newton steps; a lens that displaces the corner by a twentieth takes three or four."""


@compiled
def undistorted(xd: float, yd: float, k: Floats) -> tuple[float, float, bool]:
    """Return the undistorted point on the plane z = 1 of (xd, yd), and whether it exists."""
    far = math.sqrt(xd * xd + yd * yd)
    radius = far
    for _ in range(_UNDISTORT):
        s = radius * radius
        value = radius * (1.0 + s * (k[0] + s * (k[1] + s * k[2]))) - far
        slope = 1.0 + s * (3.0 * k[0] + s * (5.0 * k[1] + 7.0 * s * k[2]))
        if not slope > 0.0:
            return 0.0, 0.0, False
        step = value / slope
        radius -= step
        if abs(step) < 1e-14 * (1.0 + radius):
            break
    scale = radius / far if far > 0.0 else 1.0
    return xd * scale, yd * scale, True


@compiled
def flow_row(
    principal: Floats,
    focal: Floats,
    rotation: Floats,
    distortion: Floats,
    start: Floats,
    image: Floats,
    jacobian: Floats,
) -> bool:
    """Write the pixel in the second of two frames of a point in the first, and derivatives (2, 16).

    The point is a direction from the center, which both frames share.

    Args:
        principal: (2,) [px].
        focal: (2,) [px].
        rotation: (2, 3, 3).
        distortion: (2, 3).
        start: (2,) [px].
        image: (2,), written.
        jacobian: (2, 16), written: by the first frame's step, the second's, the principal point.
    """
    xd, yd = (start[0] - principal[0]) / focal[0], (start[1] - principal[1]) / focal[0]
    k = distortion[0]
    a, b, known = undistorted(xd, yd, k)
    if not known:
        return False
    # Rotation from the first camera's axes to the second's.
    turn = rotation[1] @ rotation[0].T
    x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2]
    y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2]
    z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2]
    if not z > 0.0:
        return False
    full = np.empty((2, 12))
    if not direction_row(x, y, z, turn, principal, focal[1], distortion[1], image, full):
        return False
    s = a * a + b * b
    radial = 1.0 + s * (k[0] + s * (k[1] + s * k[2]))
    slope = 2.0 * (k[0] + s * (2.0 * k[1] + 3.0 * s * k[2]))
    gxx, gxy, gyy = radial + slope * a * a, slope * a * b, radial + slope * b * b
    determinant = gxx * gyy - gxy * gxy
    for axis in range(2):
        row, second = jacobian[axis], full[axis]
        # `direction_row` gave minus the derivative by the direction in the first camera's axes.
        ha, hb, hc = -second[7], -second[8], -second[9]
        # Derivatives by the undistorted place, then by the distorted one.
        da, db = ha, hb
        pa = (gyy * da - gxy * db) / determinant
        pb = (gxx * db - gxy * da) / determinant
        row[0] = -(b * hc - hb)
        row[1] = -(ha - a * hc)
        row[2] = -(a * hb - b * ha)
        row[3] = -(pa * xd + pb * yd)
        bent = -(pa * a + pb * b) * s
        row[4], row[5], row[6] = bent, bent * s, bent * s * s
        for j in range(7):
            row[7 + j] = second[j]
        row[14] = second[10] - pa / focal[0]
        row[15] = second[11] - pb / focal[0]
    return True


@compiled
def add_flow(
    principal: Floats,
    focal: Floats,
    rotation: Floats,
    distortion: Floats,
    bounds: Integers,
    start: Floats,
    end: Floats,
    deviation: Floats,
    weight: float,
    loss: float,
    blocks: Floats,
    border: Floats,
    corner: Floats,
    right: Floats,
    right_corner: Floats,
) -> float:
    """Add followed points to the normal equations and return their cost; see `add_points`.

    Args:
        principal: (2,) [px].
        focal: (frames,) [px].
        rotation: (frames, 3, 3).
        distortion: (frames, 3).
        bounds: (frames + 1,) of the points by their first frame.
        start: (n, 2) [px].
        end: (n, 2) [px].
        deviation: (n,) [px].
        weight: factor on all their losses.
        loss: scale [standard deviations].
        blocks: (3, frames, 7, 7), the diagonal and the first below it added to.
        border: (frames, 7, 5 and more), added to.
        corner: (5 and more, the same), added to.
        right: (frames, 7), added to.
        right_corner: (5 and more,), added to.
    """
    cost = 0.0
    limit = loss * loss
    pixel, rows = np.empty(2), np.empty((2, 16))
    normal, gradient = np.empty((16, 16)), np.empty(16)
    for t in range(len(focal) - 1):
        if bounds[t] == bounds[t + 1]:
            continue
        normal[:] = 0.0
        gradient[:] = 0.0
        two = slice(t, t + 2)
        for i in range(bounds[t], bounds[t + 1]):
            if not flow_row(
                principal, focal[two], rotation[two], distortion[two], start[i], pixel, rows
            ):
                cost += 0.5 * weight * min(limit, 1e12)
                continue
            scale = 1.0 / deviation[i]
            u, v = scale * (pixel[0] - end[i, 0]), scale * (pixel[1] - end[i, 1])
            squared = u * u + v * v
            share = limit / (limit + squared) if limit < np.inf else 1.0
            cost += 0.5 * weight * squared * share
            pull = weight * share * share * scale
            for j in range(16):
                p, q = pull * rows[0, j], pull * rows[1, j]
                gradient[j] += p * u + q * v
                p, q = scale * p, scale * q
                for m in range(j + 1):
                    normal[j, m] += p * rows[0, m] + q * rows[1, m]
        for j in range(7):
            right[t, j] += gradient[j]
            right[t + 1, j] += gradient[7 + j]
            for m in range(7):
                high, low = max(j, m), min(j, m)
                blocks[0, t, j, m] += normal[high, low]
                blocks[0, t + 1, j, m] += normal[7 + high, 7 + low]
                blocks[1, t, j, m] += normal[7 + j, m]
            for m in range(2):
                border[t, j, 3 + m] += normal[14 + m, j]
                border[t + 1, j, 3 + m] += normal[14 + m, 7 + j]
        for j in range(2):
            right_corner[3 + j] += gradient[14 + j]
            for m in range(2):
                corner[3 + j, 3 + m] += normal[14 + max(j, m), 14 + min(j, m)]
    return cost
