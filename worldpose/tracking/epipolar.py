"""Association of detections across views without history, by distance between rays (T2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled
from worldpose.tracking.affinity import ray_affinity
from worldpose.tracking.intersection import intersect_people
from worldpose.tracking.person import Sighting
from worldpose.tracking.settings import TrackingSettings

LIMBS = np.array(
    [
        (5, 6),
        (5, 7),
        (6, 8),
        (7, 9),
        (8, 10),
        (5, 11),
        (6, 12),
        (11, 13),
        (12, 14),
        (13, 15),
        (14, 16),
    ]
)
"""Pairs of COCO-17 joints whose distances tell a person's size."""
LIMB_LENGTHS = np.array([0.36, 0.30, 0.30, 0.25, 0.25, 0.51, 0.51, 0.42, 0.42, 0.42, 0.42])
"""Their lengths in an adult of 1.75 m [m]: Drillis and Contini's segment ratios, with the torso
and shoulders measured between joint centres."""


@compiled
def pair_distances(
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    camera: NDArray[np.int64],
    min_joints: int,
    min_sine: float,
) -> NDArray[np.float64]:
    """Return the mean distance between the rays of every two detections of different cameras.

    Args:
        centers: (n, 3) [m], world, of each detection's camera.
        directions: (n, joints, 3) unit rays, world; NaN where not seen.
        camera: (n,) index of each detection's camera.
        min_joints: least joints seen by both.
        min_sine: least mean sine of the angle between the rays.

    Returns:
        (n, n) [m], upper triangle; infinite where two detections cannot start a group: same
        camera, too few joints in common, or rays so parallel that they meet everywhere.
    """
    n, joint_count, _ = directions.shape
    distances = np.full((n, n), np.inf)
    for a in range(n):
        for b in range(a + 1, n):
            if camera[a] == camera[b]:
                continue
            x, y, z = centers[b] - centers[a]
            total, sines, count = 0.0, 0.0, 0
            for joint in range(joint_count):
                p, q = directions[a, joint], directions[b, joint]
                nx, ny = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2]
                nz = p[0] * q[1] - p[1] * q[0]
                sine = math.sqrt(nx * nx + ny * ny + nz * nz)
                if sine > 0.0:
                    total += abs(x * nx + y * ny + z * nz) / sine
                    sines += sine
                    count += 1
            if count >= min_joints and sines >= min_sine * count:
                distances[a, b] = total / count
    return distances


def associate(
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    weights: NDArray[np.float64],
    settings: TrackingSettings,
) -> list[Sighting]:
    """Return the people that detections of at least `birth_views` cameras agree on.

    The two nearest detections start a group; every other camera adds the detection nearest to
    where they meet. A group of too few views, or of impossible size, is no person.

    Args:
        centers: (cameras, 3) [m], world.
        directions: (cameras, detections, 17, 3) unit rays, world; NaN where not seen or taken.
        weights: (cameras, detections, 17), of the squared angle; 0 where not seen or taken.
        settings: gates and least views.

    Note:
        T2. Each detection joins one group at most.
    """
    cameras = len(centers)
    birth_views = min(settings.birth_views, max(2, cameras))
    usable = np.isfinite(directions[..., 0]).sum(axis=-1) >= settings.min_joints
    if np.count_nonzero(usable.any(axis=1)) < birth_views:
        return []
    camera, detection = np.nonzero(usable)
    distances = pair_distances(
        centers[camera],
        directions[camera, detection],
        camera,
        settings.min_joints,
        math.sin(settings.min_angle),
    )
    first, second = np.nonzero(distances <= settings.epipolar_gate)
    order = np.argsort(distances[first, second], kind="stable")
    free = np.where(usable[..., None, None], directions, np.nan)
    groups: list[Sighting] = []
    for a, b in zip(first[order], second[order], strict=True):
        if not (usable[camera[a], detection[a]] and usable[camera[b], detection[b]]):
            continue
        seed = np.full(cameras, -1)
        seed[camera[[a, b]]] = detection[[a, b]]
        group = _grown(seed, centers, free, weights, settings)
        if np.count_nonzero(group.index >= 0) >= birth_views and plausible(group.joints, settings):
            groups.append(group)
            members = np.flatnonzero(group.index >= 0)
            usable[members, group.index[members]] = False
            free[members, group.index[members]] = np.nan
    return groups


def plausible(joints: NDArray[np.float64], settings: TrackingSettings) -> bool:
    """Return whether joints (17, 3) [m] have the size of a person: the median over known limbs."""
    lengths = np.linalg.norm(joints[LIMBS[:, 0]] - joints[LIMBS[:, 1]], axis=-1)
    ratios = (lengths / LIMB_LENGTHS)[np.isfinite(lengths)]
    low, high = settings.size_range
    return bool(len(ratios)) and low <= float(np.median(ratios)) <= high


def _grown(
    index: NDArray[np.int64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    weights: NDArray[np.float64],
    settings: TrackingSettings,
) -> Sighting:
    """Return the group around a seed of two detections (cameras,).

    Two rounds, the first at the wider gate: two views alone leave the place uncertain.
    """
    unknown = np.full((1, directions.shape[2], 3), np.nan)
    sine = math.sin(settings.min_angle)
    for gate in (settings.gate, settings.epipolar_gate):
        joints = intersect_people(
            centers, directions, weights, index[:, None], unknown, settings.gate, sine
        )
        distances = -ray_affinity(joints, centers, directions, settings.min_joints)[:, 0]
        best = distances.argmin(axis=1)
        ray_distance = distances[np.arange(len(centers)), best]
        index = np.where(ray_distance <= gate, best, -1)
    joints = intersect_people(
        centers, directions, weights, index[:, None], unknown, settings.gate, sine
    )
    return Sighting(index, np.where(index >= 0, ray_distance, np.nan), joints[0])
