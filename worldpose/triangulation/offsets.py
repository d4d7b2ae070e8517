"""Image offset of each person in each camera, caused by calibration errors (T4).

A camera's calibration error moves all joints of a person by about the same vector in the image,
because people are small. The vector is unknown and normal; its variance is that of calibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compiled
from worldpose.triangulation.batched_gauss_newton import (
    EXTRA,
    LANES,
    MATRIX,
    POINT,
    PRECISION,
    RIGHT,
    ROWS,
    SCALE,
    SHARPNESS,
    STATE,
    USED,
    A,
    B,
    step,
)
from worldpose.triangulation.observations import Rig, gather, linearize
from worldpose.triangulation.solving import Solution

ROUNDS: Final = 6
"""Updates of the variance factor; the last changes it by a few percent."""
DAMPING: Final = 4.0
"""Weight of the factor before an update, in degrees of freedom."""
LEAST: Final = 1e-3
"""Smallest variance factor."""


@dataclass(frozen=True, eq=False)
class Offsets:
    """Offsets of people in the images.

    Attributes:
        shift: (frames, cameras, persons, 3), the offsets [px] and a zero.
        covariance: (frames, persons, joints, 3, 3) [m^2], their contribution to the joints'
            covariance.
    """

    shift: Floats
    covariance: Floats


def learn_factor(
    rig: Rig,
    keypoints: NDArray[np.floating],
    precision: Floats,
    index: NDArray[np.integer],
    noise: tuple[float, float],
    first: Solution,
    stated: Floats,
) -> float:
    """Return the most probable factor on the stated variance for a sample of frames.

    All cameras share the factor: a camera's own error is a single draw, which does not determine
    its variance. Arguments are those of `estimate_offsets`.
    """
    factor, known = 1.0, first.inliers.any(axis=-1) & (stated > 0.0)
    scale = np.where(known, stated, 1.0)
    for _ in range(ROUNDS if known.any() else 0):
        offsets, variance = np.zeros((*stated.shape, 2)), np.zeros(stated.shape)
        _body_offsets(
            *(keypoints, precision, index, rig.cameras, rig.depths, noise),
            *(first.joints, first.inliers, factor * stated),
            *(offsets, variance, np.empty((0, 0, 0, 3, 3))),
        )
        squares = np.where(known, (offsets**2).sum(axis=-1) / scale, 0.0).sum()
        # Degrees of freedom that the observations determine (MacKay 1992).
        freedom = np.where(known, 2.0 * (1.0 - variance / (factor * scale)), 0.0).sum()
        factor = max(LEAST, float((squares + DAMPING * factor) / (freedom + DAMPING)))
    return factor


def estimate_offsets(
    rig: Rig,
    keypoints: NDArray[np.floating],
    precision: Floats,
    index: NDArray[np.integer],
    noise: tuple[float, float],
    first: Solution,
    variance: Floats,
) -> Offsets:
    """Return the most probable offsets, estimated together with the joints.

    T4 of the paper uses the mid-hip residual in each image as the offset, which adds the detector's
    hip error to every joint. All joints together determine the offset more accurately, and cameras
    that agree get none.

    Args:
        rig: the cameras.
        keypoints: (frames, cameras, detections, joints, 2) [px].
        precision: (frames, cameras, detections, joints).
        index: (frames, cameras, persons).
        noise: [px], [m].
        first: the joints without offsets.
        variance: (frames, cameras, persons) calibration variance per axis [px^2].
    """
    offsets, unknown = np.zeros((*variance.shape, 2)), np.zeros(variance.shape)
    further = np.zeros((*first.joints.shape, 3))
    _body_offsets(
        *(keypoints, precision, index, rig.cameras, rig.depths, noise),
        *(first.joints, first.inliers, variance, offsets, unknown, further),
    )
    return Offsets(np.concatenate([offsets, np.zeros((*variance.shape, 1))], axis=-1), further)


@compiled
def _body_offsets(
    keypoints: NDArray[np.floating],
    precision: NDArray[np.floating],
    index: NDArray[np.integer],
    cameras: Floats,
    depths: Floats,
    noise: tuple[float, float],
    joints: Floats,
    inliers: NDArray[np.bool_],
    prior: Floats,
    offsets: Floats,
    variance: Floats,
    further: Floats,
) -> None:
    """Write the most probable offsets of people in the images, estimated with the joints.

    All joints of a person in one image share the same offset, normal with variance `prior`. The
    joints are eliminated (Schur complement), which leaves two unknowns per camera.

    Args:
        keypoints: (frames, cameras, detections, joints, 2) [px].
        precision: (frames, cameras, detections, joints).
        index: (frames, cameras, persons).
        cameras: (cameras, 22).
        depths: (cameras, 4).
        noise: [px], [m].
        joints: (frames, persons, joints, 3) [m] solved without offsets.
        inliers: (frames, cameras, persons, joints).
        prior: (frames, cameras, persons) [px^2].
        offsets: (frames, cameras, persons, 2) [px], written.
        variance: (frames, cameras, persons) [px^2] per axis, of the offsets, written.
        further: (frames, persons, joints, 3, 3) [m^2], contribution of the offsets to the joints'
            covariance, written; no frames = not wanted.
    """
    frames, count, persons = index.shape
    joint_count = precision.shape[3]
    none = np.zeros((0, 0, 0, 3))
    tiles, state = np.empty((count, ROWS * LANES)), np.zeros(STATE * LANES)
    slot = np.empty(count, np.int64)
    for t in range(frames):
        for n in range(persons):
            for c in range(count):
                tiles[c, PRECISION : PRECISION + LANES] = 0.0
            gather(
                keypoints, precision, index, none, (t * persons + n) * joint_count, cameras, tiles
            )
            size = 0
            for c in range(count):
                linearize(tiles[c], cameras[c])
                tiles[c, USED : USED + LANES] = 0.0
                some = False
                for j in range(joint_count):
                    if inliers[t, c, n, j]:
                        tiles[c, USED + j] = 1.0
                        some = True
                slot[c] = -1
                if some and prior[t, c, n] > 0.0:
                    slot[c] = size
                    size += 2
            if size == 0:
                continue
            for j in range(joint_count):
                for k in range(3):
                    state[POINT + k * LANES + j] = joints[t, n, j, k]
            state[SHARPNESS : SHARPNESS + LANES] = 0.0
            step(tiles, depths, noise, state)
            h, right = np.zeros((size, size)), np.zeros(size)
            for c in range(count):
                if slot[c] >= 0:
                    h[slot[c], slot[c]] = h[slot[c] + 1, slot[c] + 1] = 1.0 / prior[t, c, n]
            w, moves = np.zeros((size, 3)), np.zeros((joint_count, size, 3))
            for j in range(joint_count):
                if not math.isfinite(joints[t, n, j, 0]):
                    continue
                x, y, z = joints[t, n, j]
                w[:] = 0.0
                for c in range(count):
                    at = slot[c]
                    if at < 0 or tiles[c, USED + j] == 0.0:
                        continue
                    tile, p = tiles[c], depths[c]
                    inverse = 1.0 / (p[0] * x + p[1] * y + p[2] * z + p[3])
                    g = tile[PRECISION + j]
                    weight = g / (
                        noise[0] ** 2
                        + tile[SCALE + j] * inverse * inverse * noise[1] ** 2
                        + g * tile[EXTRA + j]
                    )
                    for axis in range(2):
                        o = (A if axis == 0 else B) + j
                        a, b, d = tile[o], tile[o + LANES], tile[o + 2 * LANES]
                        e = (a * x + b * y + d * z + tile[o + 3 * LANES]) * inverse
                        w[at + axis, 0] = weight * (a - e * p[0]) * inverse
                        w[at + axis, 1] = weight * (b - e * p[1]) * inverse
                        w[at + axis, 2] = weight * (d - e * p[2]) * inverse
                        h[at + axis, at + axis] += weight
                        # The errors are projection less observation: the offset's sign flips.
                        right[at + axis] -= weight * e
                xx, xy, xz = (
                    state[MATRIX + j],
                    state[MATRIX + LANES + j],
                    state[MATRIX + 2 * LANES + j],
                )
                yy, yz = state[MATRIX + 3 * LANES + j], state[MATRIX + 4 * LANES + j]
                zz = state[MATRIX + 5 * LANES + j]
                both = moves[j]
                for i in range(size):
                    u, v, q = w[i, 0], w[i, 1], w[i, 2]
                    both[i, 0] = u * xx + v * xy + q * xz
                    both[i, 1] = u * xy + v * yy + q * yz
                    both[i, 2] = u * xz + v * yz + q * zz
                    for k in range(3):
                        right[i] -= both[i, k] * state[RIGHT + k * LANES + j]
                for i in range(size):
                    for k in range(size):
                        h[i, k] -= (
                            both[i, 0] * w[k, 0] + both[i, 1] * w[k, 1] + both[i, 2] * w[k, 2]
                        )
            covariance = np.linalg.inv(h)
            for c in range(count):
                at = slot[c]
                if at < 0:
                    continue
                for axis in range(2):
                    total = 0.0
                    for k in range(size):
                        total += covariance[at + axis, k] * right[k]
                    offsets[t, c, n, axis] = total
                variance[t, c, n] = 0.5 * (covariance[at, at] + covariance[at + 1, at + 1])
            for j in range(joint_count if len(further) else 0):
                further[t, n, j] = moves[j].T @ (covariance @ moves[j])
