"""Affinity of people and detections by point-to-ray distance, and greedy matching (T1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled


@compiled
def ray_affinity(
    joints: NDArray[np.float64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    min_joints: int,
) -> NDArray[np.float64]:
    """Return minus the mean distance of each person's joints to each detection's rays.

    Args:
        joints: (persons, joints, 3) [m], world; NaN where unknown.
        centers: (cameras, 3) [m], world, where the rays begin.
        directions: (cameras, detections, joints, 3) unit rays, world; NaN where not seen.
        min_joints: least joints known on both sides.

    Returns:
        (cameras, persons, detections) [-m]; minus infinity with too few joints in common.

    Note:
        T1: the mean runs over the joints known on both sides.
    """
    cameras, detections, joint_count, _ = directions.shape
    persons = joints.shape[0]
    affinity = np.full((cameras, persons, detections), -np.inf)
    for c in range(cameras):
        for person in range(persons):
            for detection in range(detections):
                total, count = 0.0, 0
                for joint in range(joint_count):
                    d = distance(joints[person, joint], centers[c], directions[c, detection, joint])
                    if not math.isnan(d):
                        total += d
                        count += 1
                if count >= min_joints:
                    affinity[c, person, detection] = -total / count
    return affinity


@compiled
def distance(
    point: NDArray[np.float64], center: NDArray[np.float64], direction: NDArray[np.float64]
) -> float:
    """Return the distance [m] of a point to a ray; NaN where either is missing.

    A point behind the camera is as far as the camera.
    """
    x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    along = max(0.0, x * direction[0] + y * direction[1] + z * direction[2])
    x -= along * direction[0]
    y -= along * direction[1]
    z -= along * direction[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def match_greedily(affinity: NDArray[np.float64], gate: float) -> NDArray[np.int64]:
    """Return each person's detection in every camera, best pairs first.

    Args:
        affinity: (cameras, persons, detections) [-m].
        gate: largest accepted distance [m].

    Returns:
        (cameras, persons) place among the detections, each used once; -1 = none. Of equal pairs
        the first person's, then the first detection's is taken.
    """
    cameras, persons, detections = affinity.shape
    index = np.full((cameras, persons), -1)
    for c in range(cameras):
        flat = -affinity[c].ravel()
        candidates = np.flatnonzero(flat <= gate)
        taken = np.zeros(detections, np.bool_)
        for place in candidates[np.argsort(flat[candidates], kind="mergesort")]:
            person, detection = place // detections, place % detections
            if index[c, person] < 0 and not taken[detection]:
                index[c, person] = detection
                taken[detection] = True
    return index
