"""Agreement of two cameras: number of detections of the same person, frame by frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled

MIN_JOINTS = 6
"""Least number of common joints of two detections."""
MIN_SINE = 0.08
"""Least sine of the angle between two rays: nearly parallel rays meet everywhere."""
CLIP = 16.0
"""Largest squared deviation of one joint: an outlier counts no more."""
EARLY_JOINTS, EARLY_LIMIT = 4, 13.0
"""After this number of joints a pair with a larger mean squared deviation is rejected."""
WIDTH = 1.5
"""Deviation at which a match counts 61 %: the noise is uncertain by a factor of about two."""
SIZE_RANGE = (0.15, 1.1)
"""Accepted root mean square distance of a person's joints from their mean [m]: about 0.45 for a
standing adult, more along nearly parallel rays."""


@compiled
def pair_scores(
    rays_a: NDArray[np.float64],
    center_a: NDArray[np.float64],
    spread_a: NDArray[np.float64],
    frames_a: NDArray[np.int64],
    rays_b: NDArray[np.float64],
    center_b: NDArray[np.float64],
    spread_b: NDArray[np.float64],
    frames_b: NDArray[np.int64],
    heights: tuple[float, float],
    joint_noise: float,
) -> NDArray[np.float64]:
    """Return the number of one-to-one matches between two cameras' detections, frame by frame.

    A match counts between 0 and 1, by the distance between its rays in standard deviations. The
    assignment is greedy, best first.

    Args:
        rays_a: (frames, detections, 17, 3) unit rays of the first camera, world; NaN where not
            seen.
        center_a: (3,) [m], world, its position.
        spread_a: (frames, detections) standard deviation of a ray's direction [rad].
        frames_a: (n,) compared frames; -1 = none.
        rays_b: the same of the second camera.
        center_b: its position.
        spread_b: its spread.
        frames_b: (n,) frame of the second camera for each of `frames_a`.
        heights: lowest and highest mean height of a person's joints [m]; infinite where the
            ground is unknown.
        joint_noise: standard deviation of a detector's joint, on the body [m].

    Returns:
        (n,) sums of matches [1].
    """
    scores = np.zeros(len(frames_a))
    for n in range(len(frames_a)):
        fa, fb = frames_a[n], frames_b[n]
        if fa < 0 or fb < 0:
            continue
        weights = _weights(
            rays_a[fa],
            center_a,
            spread_a[fa],
            rays_b[fb],
            center_b,
            spread_b[fb],
            heights,
            joint_noise,
        )
        scores[n] = _one_to_one(weights)
    return scores


@compiled
def _one_to_one(weights: NDArray[np.float64]) -> float:
    """Return the sum of the best pairs, each row and column used once; clears `weights`."""
    total = 0.0
    rows, columns = weights.shape
    while True:
        best, row, column = 0.0, -1, -1
        for i in range(rows):
            for j in range(columns):
                if weights[i, j] > best:
                    best, row, column = weights[i, j], i, j
        if row < 0:
            return total
        total += best
        weights[row, :] = 0.0
        weights[:, column] = 0.0


@compiled
def _weights(
    rays_a: NDArray[np.float64],
    center_a: NDArray[np.float64],
    spread_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    center_b: NDArray[np.float64],
    spread_b: NDArray[np.float64],
    heights: tuple[float, float],
    joint_noise: float,
) -> NDArray[np.float64]:
    """Return the match weights of every two detections (a, b), 0 to 1."""
    count_a, joints, _ = rays_a.shape
    count_b = rays_b.shape[0]
    weights = np.zeros((count_a, count_b))
    bx, by, bz = center_b[0] - center_a[0], center_b[1] - center_a[1], center_b[2] - center_a[2]
    points = np.empty((joints, 3))
    for i in range(count_a):
        for j in range(count_b):
            count, total = 0, 0.0
            for step in range(joints):
                # From the torso outwards: the face comes last.
                joint = (11 + step) % joints if step < 6 else (5 + step - 6) % joints
                if step >= 12:
                    joint = step - 12
                ux, uy, uz = rays_a[i, joint, 0], rays_a[i, joint, 1], rays_a[i, joint, 2]
                vx, vy, vz = rays_b[j, joint, 0], rays_b[j, joint, 1], rays_b[j, joint, 2]
                cosine = ux * vx + uy * vy + uz * vz
                squared = 1.0 - cosine * cosine
                if not squared > MIN_SINE * MIN_SINE:  # also NaN
                    continue
                along_u = bx * ux + by * uy + bz * uz
                along_v = bx * vx + by * vy + bz * vz
                s = (along_u - cosine * along_v) / squared
                t = (cosine * along_u - along_v) / squared
                if s <= 0.0 or t <= 0.0:  # the rays meet behind a camera
                    total = math.inf
                    break
                dx, dy, dz = s * ux - bx - t * vx, s * uy - by - t * vy, s * uz - bz - t * vz
                variance = (s * spread_a[i]) ** 2 + (t * spread_b[j]) ** 2
                variance += 2.0 * joint_noise**2
                points[count, 0] = center_a[0] + s * ux - 0.5 * dx
                points[count, 1] = center_a[1] + s * uy - 0.5 * dy
                points[count, 2] = center_a[2] + s * uz - 0.5 * dz
                total += min(CLIP, (dx * dx + dy * dy + dz * dz) / variance)
                count += 1
                if count == EARLY_JOINTS and total > EARLY_LIMIT * EARLY_JOINTS:
                    break
            if count < MIN_JOINTS:
                continue
            weight = math.exp(-0.5 * total / count / WIDTH**2)
            if weight > 0.05 and _is_person(points[:count], heights):
                weights[i, j] = weight
    return weights


@compiled
def _is_person(points: NDArray[np.float64], heights: tuple[float, float]) -> bool:
    """Return whether joints (n, 3) [m] have a person's size and height above the ground."""
    n = len(points)
    x = y = z = xx = 0.0
    for k in range(n):
        x += points[k, 0] / n
        y += points[k, 1] / n
        z += points[k, 2] / n
    for k in range(n):
        xx += ((points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2 + (points[k, 2] - z) ** 2) / n
    low, high = SIZE_RANGE
    return low * low <= xx <= high * high and heights[0] <= z <= heights[1]
