"""Compiled cost and normal equations of known points in all frames (M3, M4).

Unknowns are seven parameters per frame, five shared by all frames, and the paint errors of the
template's points; the matrix is an arrow: a band of frame blocks, and a border of shared unknowns.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compile_kernel


class Lens(NamedTuple):
    """Projection of one frame."""

    principal_point: Floats
    """(2,) [px]"""
    focal: float
    """[px]"""
    distortion: Floats
    """(3,) k1, k2, k3."""


class Cameras(NamedTuple):
    """Cameras of all frames."""

    center: Floats
    """(3,) [m], world."""
    principal_point: Floats
    """(2,) [px]"""
    focal: Floats
    """(frames,) [px]"""
    rotation: Floats
    """(frames, 3, 3)"""
    distortion: Floats
    """(frames, 3)"""


class Points(NamedTuple):
    """Pixels of known world points; see `PointEvidence`."""

    world: Floats
    """(n, 3) [m]"""
    image: Floats
    """(n, 2) [px]"""
    whitening: Floats
    """(n, 2, 2) [1/px]"""
    weight: Floats
    """(n,)"""
    loss: Floats
    """(n,) scale of the Geman-McClure loss; infinite = squares."""
    ends: Integers
    """(n, 2) rows of the paint errors that define a point; -1 = none."""
    shares: Floats
    """(n, 2) [m] displacement of the point per unit of these."""
    by_size: Floats
    """(n, 2, 3) [m] displacement along x, y, z per unit of the pitch's length, width and crown, and
    along z per unit of its end fall."""
    size_row: int
    """First of two rows of the paint errors that hold the pitch's size; -1 = the size is known."""


class Flow(NamedTuple):
    """Points followed to the next frame; see `FlowEvidence`."""

    start: Floats
    """(n, 2) [px]"""
    end: Floats
    """(n, 2) [px]"""
    deviation: Floats
    """(n,) [px]"""
    weight: float
    """Factor on all their losses."""
    loss: float
    """Scale of the Geman-McClure loss [standard deviations]."""


class NormalEquations(NamedTuple):
    """Arrow matrix and gradient, which the terms of the cost are added to."""

    blocks: Floats
    """(3, frames, 7, 7) band, see `BandedFactor`."""
    border: Floats
    """(frames, 7, 5 + 3 painted)"""
    corner: Floats
    """(5 + 3 painted, the same)"""
    right: Floats
    """(frames, 7) gradient by the frames' steps."""
    right_corner: Floats
    """(5 + 3 painted,) gradient by the clip's step and the paint errors."""


def empty_equations(frames: int, shared: int) -> NormalEquations:
    """Return normal equations without any term, for unknowns of frames and shared ones."""
    return NormalEquations(
        blocks=np.zeros((3, frames, 7, 7)),
        border=np.zeros((frames, 7, shared)),
        corner=np.zeros((shared, shared)),
        right=np.zeros((frames, 7)),
        right_corner=np.zeros(shared),
    )


@compile_kernel
def point_row(
    r: Floats, center: Floats, lens: Lens, world: Floats, image: Floats, jacobian: Floats
) -> bool:
    """Write a point's pixel (2,) and its derivatives (2, 12); return whether the pixel exists.

    Derivatives are by a frame's step, then by the clip's.
    """
    d0, d1, d2 = world[0] - center[0], world[1] - center[1], world[2] - center[2]
    x = r[0, 0] * d0 + r[0, 1] * d1 + r[0, 2] * d2
    y = r[1, 0] * d0 + r[1, 1] * d1 + r[1, 2] * d2
    z = r[2, 0] * d0 + r[2, 1] * d1 + r[2, 2] * d2
    # A camera in the stands sees no point within half a metre.
    if not z > 0.5:
        return False
    return direction_row(x, y, z, r, lens, image, jacobian)


@compile_kernel
def direction_row(
    x: float, y: float, z: float, r: Floats, lens: Lens, image: Floats, jacobian: Floats
) -> bool:
    """Write the pixel of a point in camera axes and its derivatives, as `point_row`."""
    principal, focal, k = lens.principal_point, lens.focal, lens.distortion
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


@compile_kernel
def displace_point(points: Points, i: int, paint_offsets: Floats, place: Floats) -> None:
    """Write the place (3,) of a point with its paint errors and the pitch's size."""
    place[:] = points.world[i]
    for end in range(2):
        row = points.ends[i, end]
        if row >= 0:
            for j in range(3):
                place[j] += points.shares[i, end] * paint_offsets[row, j]
    if points.size_row >= 0:
        for kind in range(2):
            for j in range(3):
                offset = paint_offsets[points.size_row + kind, j]
                place[j] += points.by_size[i, kind, j] * offset


@compile_kernel
def displacement(points: Points, i: int, one: int) -> tuple[int, float]:
    """Return the row of the paint errors, -1 = none, and a point's displacement by them.

    The number `one` is 3 * source + axis; sources are two template points, and two rows of the
    pitch's size.
    """
    source, axis = one // 3, one % 3
    if source < 2:
        return points.ends[i, source], points.shares[i, source]
    share = points.by_size[i, source - 2, axis]
    return (points.size_row + source - 2 if share != 0.0 else -1), share


@compile_kernel
def add_points(
    cameras: Cameras,
    bounds: Integers,
    points: Points,
    paint_offsets: Floats,
    equations: NormalEquations,
) -> float:
    """Add points to the normal equations and return their cost, half the sum of their losses.

    Points `bounds[t]` to `bounds[t + 1]` belong to frame t; paint errors (painted, 3) of the
    template's points are in standard deviations.
    """
    center, rotation = cameras.center, cameras.rotation
    image, whitening, weight, loss = points.image, points.whitening, points.weight, points.loss
    blocks, border, corner = equations.blocks, equations.border, equations.corner
    right, right_corner = equations.right, equations.right_corner
    cost = 0.0
    pixel, rows = np.empty(2), np.empty((2, 12))
    place, moved, row_of = np.empty(3), np.empty(12), np.empty(12, dtype=np.int64)
    sources = 6 if points.size_row < 0 else 12
    normal, gradient = np.empty((12, 12)), np.empty(12)
    white = np.empty(12)
    for t in range(len(rotation)):
        normal[:] = 0.0
        gradient[:] = 0.0
        lens = Lens(cameras.principal_point, cameras.focal[t], cameras.distortion[t])
        for i in range(bounds[t], bounds[t + 1]):
            limit = loss[i] * loss[i]
            displace_point(points, i, paint_offsets, place)
            if not point_row(rotation[t], center, lens, place, pixel, rows):
                # The maximum of the loss.
                cost += 0.5 * weight[i] * min(limit, 1e12)
                continue
            u, v = pixel[0] - image[i, 0], pixel[1] - image[i, 1]
            squared = 0.0
            for axis in range(2):
                e = whitening[i, axis, 0] * u + whitening[i, axis, 1] * v
                squared += e * e
            factor = weight[i]
            if limit < np.inf:
                share = limit / (limit + squared)
                cost += 0.5 * weight[i] * squared * share
                factor *= share * share
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
                    value = factor * white[j]
                    gradient[j] += value * e
                    for m in range(j + 1):
                        normal[j, m] += value * white[m]
                for one in range(sources):
                    # The derivative by the point is minus the derivative by the center.
                    first, share = displacement(points, i, one)
                    moved[one] = -white[7 + one % 3] * share
                    row_of[one] = -1 if first < 0 else 5 + 3 * first + one % 3
                for one in range(sources):
                    row = row_of[one]
                    if row < 0:
                        continue
                    value = factor * moved[one]
                    right_corner[row] += value * e
                    for j in range(7):
                        border[t, j, row] += value * white[j]
                    for j in range(5):
                        corner[row, j] += value * white[7 + j]
                        corner[j, row] += value * white[7 + j]
                    for other in range(sources):
                        if row_of[other] >= 0:
                            corner[row, row_of[other]] += value * moved[other]
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


@compile_kernel
def undistort_point(xd: float, yd: float, k: Floats) -> tuple[float, float, bool]:
    """Undistort the point (xd, yd) of the plane z = 1.

    Returns:
        x and y of the undistorted point, and whether there is one.
    """
    far = math.sqrt(xd * xd + yd * yd)
    radius = far
    # A lens that displaces the corner by a twentieth takes three or four Newton steps.
    for _ in range(30):
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


@compile_kernel
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

    The point is a direction from the center, which both frames share. Derivatives are by the first
    frame's step, the second's, and the principal point.
    """
    xd, yd = (start[0] - principal[0]) / focal[0], (start[1] - principal[1]) / focal[0]
    k = distortion[0]
    a, b, known = undistort_point(xd, yd, k)
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
    lens = Lens(principal, focal[1], distortion[1])
    if not direction_row(x, y, z, turn, lens, image, full):
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


@compile_kernel
def add_flow(cameras: Cameras, bounds: Integers, flow: Flow, equations: NormalEquations) -> float:
    """Add followed points to the normal equations and return their cost; see `add_points`.

    Points `bounds[t]` to `bounds[t + 1]` begin in frame t.
    """
    principal, focal = cameras.principal_point, cameras.focal
    rotation, distortion = cameras.rotation, cameras.distortion
    start, end, deviation = flow.start, flow.end, flow.deviation
    weight, loss = flow.weight, flow.loss
    blocks, border, corner = equations.blocks, equations.border, equations.corner
    right, right_corner = equations.right, equations.right_corner
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
            factor = weight * share * share * scale
            for j in range(16):
                p, q = factor * rows[0, j], factor * rows[1, j]
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
