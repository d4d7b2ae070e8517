"""Compiled cost and normal equations of known points in all frames (M3, M4).

Unknowns are seven parameters per frame, five shared by all frames, and the paint errors of the
template's points; the matrix is an arrow: a band of frame blocks, and a border of shared unknowns.
"""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compiled

_NEAR = 0.5
"""Minimum depth of a point [m]: a camera in the stands sees none nearer."""


@compiled
def point_row(
    r: Floats,
    center: Floats,
    principal: Floats,
    focal: float,
    k: Floats,
    world: Floats,
    image: Floats,
    jacobian: Floats,
) -> bool:
    """Write the pixel (2,) of a point and its derivatives (2, 12); return whether it exists.

    Args:
        r: (3, 3) rotation.
        center: (3,) [m], world.
        principal: (2,) [px].
        focal: [px].
        k: (3,) distortion.
        world: (3,) [m].
        image: (2,), written.
        jacobian: (2, 12), written: by a frame's step, then by the clip's.
    """
    d0, d1, d2 = world[0] - center[0], world[1] - center[1], world[2] - center[2]
    x = r[0, 0] * d0 + r[0, 1] * d1 + r[0, 2] * d2
    y = r[1, 0] * d0 + r[1, 1] * d1 + r[1, 2] * d2
    z = r[2, 0] * d0 + r[2, 1] * d1 + r[2, 2] * d2
    if not z > _NEAR:
        return False
    return direction_row(x, y, z, r, principal, focal, k, image, jacobian)


@compiled
def direction_row(
    x: float,
    y: float,
    z: float,
    r: Floats,
    principal: Floats,
    focal: float,
    k: Floats,
    image: Floats,
    jacobian: Floats,
) -> bool:
    """Write the pixel of a point in camera axes and its derivatives, as `point_row`."""
    a, b = x / z, y / z
    s = a * a + b * b
    radial = 1.0 + s * (k[0] + s * (k[1] + s * k[2]))
    slope = 2.0 * (k[0] + s * (2.0 * k[1] + 3.0 * s * k[2]))
    # Where the lens model folds back there is no image.
    if not (radial + s * slope > 0.0 and radial > 0.0):
        return False
    image[0], image[1] = focal * radial * a + principal[0], focal * radial * b + principal[1]
    for axis in range(2):
        along = a if axis == 0 else b
        gx = radial + slope * a * a if axis == 0 else slope * a * b
        gy = slope * a * b if axis == 0 else radial + slope * b * b
        hx, hy = focal * gx / z, focal * gy / z
        hz = -(hx * a + hy * b)
        row = jacobian[axis]
        row[0], row[1], row[2] = y * hz - z * hy, z * hx - x * hz, x * hy - y * hx
        bent = focal * along * s
        row[3] = focal * radial * along
        row[4], row[5], row[6] = bent, bent * s, bent * s * s
        for j in range(3):
            row[7 + j] = -(hx * r[0, j] + hy * r[1, j] + hz * r[2, j])
        row[10] = 1.0 if axis == 0 else 0.0
        row[11] = 0.0 if axis == 0 else 1.0
    return True


@compiled
def add_points(
    center: Floats,
    principal: Floats,
    focal: Floats,
    rotation: Floats,
    distortion: Floats,
    bounds: Integers,
    world: Floats,
    image: Floats,
    whitening: Floats,
    weight: Floats,
    loss: Floats,
    ends: Integers,
    shares: Floats,
    beside: Floats,
    blocks: Floats,
    border: Floats,
    corner: Floats,
    right: Floats,
    right_corner: Floats,
) -> float:
    """Add points to the normal equations and return their cost, half a sum of losses.

    Args:
        center: (3,) [m], world.
        principal: (2,) [px].
        focal: (frames,) [px].
        rotation: (frames, 3, 3).
        distortion: (frames, 3).
        bounds: (frames + 1,) of the points.
        world: (n, 3) [m].
        image: (n, 2) [px].
        whitening: (n, 2, 2) [1/px].
        weight: (n,).
        loss: (n,) scale of the Geman-McClure loss; infinite = squares.
        ends: (n, 2) rows of `beside` that define a point; -1 = none.
        shares: (n, 2) [m] displacement of the point per unit of these.
        beside: (painted, 3) paint errors of the template's points [standard deviations].
        blocks: (3, frames, 7, 7), the diagonal added to.
        border: (frames, 7, 5 + 3 painted), added to.
        corner: (5 + 3 painted, 5 + 3 painted), added to.
        right: (frames, 7) gradient, added to.
        right_corner: (5 + 3 painted,), added to.
    """
    cost = 0.0
    pixel, rows = np.empty(2), np.empty((2, 12))
    place, moved = np.empty(3), np.empty(6)
    normal, gradient = np.empty((12, 12)), np.empty(12)
    white = np.empty(12)
    for t in range(len(focal)):
        normal[:] = 0.0
        gradient[:] = 0.0
        for i in range(bounds[t], bounds[t + 1]):
            limit = loss[i] * loss[i]
            place[:] = world[i]
            for end in range(2):
                if ends[i, end] >= 0:
                    for j in range(3):
                        place[j] += shares[i, end] * beside[ends[i, end], j]
            seen = point_row(
                rotation[t], center, principal, focal[t], distortion[t], place, pixel, rows
            )
            if not seen:
                # The maximum of the loss.
                cost += 0.5 * weight[i] * min(limit, 1e12)
                continue
            u, v = pixel[0] - image[i, 0], pixel[1] - image[i, 1]
            squared = 0.0
            for axis in range(2):
                e = whitening[i, axis, 0] * u + whitening[i, axis, 1] * v
                squared += e * e
            pull = weight[i]
            if limit < np.inf:
                share = limit / (limit + squared)
                cost += 0.5 * weight[i] * squared * share
                pull *= share * share
            else:
                cost += 0.5 * weight[i] * squared
            for axis in range(2):
                p, q = whitening[i, axis, 0], whitening[i, axis, 1]
                if p == 0.0 and q == 0.0:
                    continue
                e = p * u + q * v
                for j in range(12):
                    white[j] = p * rows[0, j] + q * rows[1, j]
                for j in range(12):
                    value = pull * white[j]
                    gradient[j] += value * e
                    for m in range(j + 1):
                        normal[j, m] += value * white[m]
                for end in range(2):
                    # The derivative by the point is minus the derivative by the center.
                    for j in range(3):
                        moved[3 * end + j] = -white[7 + j] * shares[i, end]
                for one in range(6):
                    if ends[i, one // 3] < 0:
                        continue
                    row = 5 + 3 * ends[i, one // 3] + one % 3
                    value = pull * moved[one]
                    right_corner[row] += value * e
                    for j in range(7):
                        border[t, j, row] += value * white[j]
                    for j in range(5):
                        corner[row, j] += value * white[7 + j]
                        corner[j, row] += value * white[7 + j]
                    for other in range(6):
                        if ends[i, other // 3] >= 0:
                            column = 5 + 3 * ends[i, other // 3] + other % 3
                            corner[row, column] += value * moved[other]
        for j in range(7):
            right[t, j] += gradient[j]
            for m in range(j + 1):
                blocks[0, t, j, m] += normal[j, m]
                if m < j:
                    blocks[0, t, m, j] += normal[j, m]
            for m in range(5):
                border[t, j, m] += normal[7 + m, j]
        for j in range(5):
            right_corner[j] += gradient[7 + j]
            for m in range(j + 1):
                corner[j, m] += normal[7 + j, 7 + m]
                if m < j:
                    corner[m, j] += normal[7 + j, 7 + m]
    return cost
