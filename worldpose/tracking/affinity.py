"""Affinity of people and detections by point-to-ray distance, and matching on it (T1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from worldpose.compiled import compiled


@compiled
def ray_affinity(
    joints: NDArray[np.float64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    weights: NDArray[np.float64],
    gates: NDArray[np.float64],
    min_joints: int,
) -> NDArray[np.float64]:
    """Return minus the mean distance of each person's joints to each detection's rays.

    Args:
        joints: (persons, joints, 3) [m], world; NaN where unknown.
        centers: (cameras, 3) [m], world, origins of the rays.
        directions: (cameras, detections, joints, 3) unit rays, world.
        weights: (cameras, detections, joints), 0 or less where not seen; only the sign counts.
        gates: (cameras, persons) [m], distances beyond which no affinity is computed.
        min_joints: least number of joints known on both sides.

    Returns:
        (cameras, persons, detections) [-m]; minus infinity with too few joints in common or
        beyond the gate.

    Note:
        T1: the plain mean over the joints known on both sides. Computation of a pair stops as soon
        as the joints so far put its mean beyond the gate, whatever the distance of the others.
    """
    cameras, detections, joint_count, _ = directions.shape
    persons = joints.shape[0]
    affinity = np.full((cameras, persons, detections), -np.inf)
    for c in range(cameras):
        cx, cy, cz = centers[c]
        for detection in range(detections):
            seen = 0
            for joint in range(joint_count):
                if weights[c, detection, joint] > 0.0:
                    seen += 1
            if seen < min_joints:
                continue
            for person in range(persons):
                total, count = 0.0, 0
                too_far = gates[c, person] * seen
                for joint in range(joint_count):
                    if not weights[c, detection, joint] > 0.0:
                        continue
                    if math.isnan(joints[person, joint, 0]):
                        continue
                    x, y = joints[person, joint, 0] - cx, joints[person, joint, 1] - cy
                    z = joints[person, joint, 2] - cz
                    u, v = directions[c, detection, joint, 0], directions[c, detection, joint, 1]
                    n = directions[c, detection, joint, 2]
                    along = max(0.0, x * u + y * v + z * n)
                    x, y, z = x - along * u, y - along * v, z - along * n
                    total += math.sqrt(x * x + y * y + z * z)
                    count += 1
                    if total > too_far:
                        break
                if count >= min_joints and total <= gates[c, person] * count:
                    affinity[c, person, detection] = -total / count
    return affinity


@compiled
def distance(
    x: float, y: float, z: float, center: NDArray[np.float64], direction: NDArray[np.float64]
) -> float:
    """Return the distance [m] of a point to a ray; NaN where either is missing.

    For a point behind the camera, the distance to the camera counts.
    """
    x, y, z = x - center[0], y - center[1], z - center[2]
    along = max(0.0, x * direction[0] + y * direction[1] + z * direction[2])
    x -= along * direction[0]
    y -= along * direction[1]
    z -= along * direction[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def match_greedily(affinity: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return each person's detection in every camera, best pairs first.

    Args:
        affinity: (cameras, persons, detections); minus infinity = no match.

    Returns:
        (cameras, persons) index of the detection, each used once; -1 = none. Of equal pairs the
        first person's, then the first detection's wins.
    """
    cameras, persons, detections = affinity.shape
    index = np.full((cameras, persons), -1)
    for c in range(cameras):
        flat = -affinity[c].copy().ravel()
        candidates = np.flatnonzero(flat < np.inf)
        taken = np.zeros(detections, np.bool_)
        for place in candidates[np.argsort(flat[candidates], kind="mergesort")]:
            person, detection = place // detections, place % detections
            if index[c, person] < 0 and not taken[detection]:
                index[c, person] = detection
                taken[detection] = True
    return index


@compiled
def nearest_detections(
    affinity: NDArray[np.float64], unmatched: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return each person's best detection (cameras, persons), and the cameras where two share one.

    Args:
        affinity: (cameras, persons, detections); minus infinity = no match.
        unmatched: affinity of a person without detection.
    """
    cameras, persons, detections = affinity.shape
    index, shared = np.full((cameras, persons), -1), np.zeros(cameras, np.bool_)
    for c in range(cameras):
        taken = np.zeros(detections, np.bool_)
        for person in range(persons):
            best = unmatched
            for detection in range(detections):
                if affinity[c, person, detection] > best:
                    best = affinity[c, person, detection]
                    index[c, person] = detection
            if index[c, person] >= 0:
                shared[c] |= taken[index[c, person]]
                taken[index[c, person]] = True
    return index, shared


def match_optimally(affinity: NDArray[np.float64], unmatched: float) -> NDArray[np.int64]:
    """Return each person's detection in every camera, with the largest sum of affinities.

    Args:
        affinity: (cameras, persons, detections); minus infinity = no match.
        unmatched: affinity of a person without detection.

    Returns:
        (cameras, persons) index of the detection, each used once; -1 = none (Hungarian method, if
        the best detections of two people are the same).
    """
    index, shared = nearest_detections(affinity, unmatched)
    for c in np.flatnonzero(shared):
        gains = affinity[c]
        possible = gains > unmatched
        persons, detections = np.flatnonzero(possible.any(1)), np.flatnonzero(possible.any(0))
        part = np.maximum(gains[np.ix_(persons, detections)], unmatched)
        row, column = linear_sum_assignment(part, maximize=True)
        good = part[row, column] > unmatched
        index[c] = -1
        index[c, persons[row[good]]] = detections[column[good]]
    return index
