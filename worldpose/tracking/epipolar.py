"""Association of detections across views without history, by distance between rays."""

from __future__ import annotations

import math

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.conventions import COCO17_BODY_BONES
from worldpose.compiled import compile_kernel
from worldpose.tracking.person import Sighting
from worldpose.tracking.ray_matching import intersect_people, ray_affinity, rays_apart
from worldpose.tracking.settings import TrackingSettings

LIMBS = np.array(COCO17_BODY_BONES)
"""Pairs of COCO-17 joints whose distances measure a person's size."""
ADULT_LENGTHS = np.array([0.36, 0.30, 0.30, 0.25, 0.25, 0.51, 0.51, 0.42, 0.42, 0.42, 0.42])
"""Lengths of `LIMBS` in an adult of 1.75 m [m]: Drillis and Contini's segment ratios, with the
torso and shoulders measured between joint centres."""


def size_ratios(joints: Floats) -> Floats:
    """Return the limb lengths (..., 11) of joints (..., 17, 3) [m] over those of an adult [1]."""
    ends = joints[..., LIMBS[:, 0], :], joints[..., LIMBS[:, 1], :]
    return np.asarray(np.linalg.norm(ends[0] - ends[1], axis=-1) / ADULT_LENGTHS)


def has_adult_size(joints: Floats, size_range: tuple[float, float]) -> bool:
    """Return whether joints (17, 3) [m] have the size of a person: the median over known limbs."""
    ratios = size_ratios(joints)
    ratios = ratios[np.isfinite(ratios)]
    low, high = size_range
    return bool(len(ratios)) and low <= float(np.median(ratios)) <= high


def limb_lengths(joints: Floats, fps: float) -> tuple[Floats, Floats]:
    """Return median limb lengths (11,) [m] over a track and their variance (11,) [m^2].

    Args:
        joints: (n, 17, 3) [m], world; NaN where not determined.
        fps: frames per second [1/s].

    Returns:
        NaN for limbs never determined.
    """
    lengths = np.linalg.norm(joints[:, LIMBS[:, 0]] - joints[:, LIMBS[:, 1]], axis=-1)
    median, variance = np.full(len(LIMBS), np.nan), np.full(len(LIMBS), np.nan)
    for limb, every in enumerate(lengths.T):
        known = every[np.isfinite(every)]
        if len(known):
            median[limb] = np.median(known)
            # 5 cm for a single frame, else the scatter between frames if larger.
            spread = max(0.05, 1.4826 * float(np.median(np.abs(known - median[limb]))))
            # Correlation time of a detector's errors [s]: frames nearer to each other add no
            # information.
            variance[limb] = spread**2 / max(1.0, len(known) / (0.3 * fps))
    return median, variance


@compile_kernel
def footprints(centers: Floats, directions: Floats, ground: tuple[float, float]) -> Floats:
    """Return the ground position of each detection's person (n, 3): x, y and uncertainty [m].

    The mean of unit rays (n, joints, 3), NaN where not seen, from camera centers (n, 3) [m], world,
    is cut at the height of a body's centre; the uncertainty is the length of its ground track
    within the possible heights. `ground` is their middle and half extent [m]; an infinite extent =
    no ground.
    """
    n, joint_count, _ = directions.shape
    places = np.zeros((n, 3))
    for a in range(n):
        x = y = z = 0.0
        for joint in range(joint_count):
            if not math.isnan(directions[a, joint, 0]):
                x += directions[a, joint, 0]
                y += directions[a, joint, 1]
                z += directions[a, joint, 2]
        way = (ground[0] - centers[a, 2]) / z if z != 0.0 else -1.0
        if ground[1] < math.inf and way > 0.0:
            places[a, 0], places[a, 1] = centers[a, 0] + way * x, centers[a, 1] + way * y
            places[a, 2] = ground[1] * math.hypot(x, y) / abs(z)
        else:
            places[a, 2] = math.inf
    return places


@compile_kernel
def pair_distances(
    centers: Floats,
    directions: Floats,
    camera: Integers,
    places: Floats,
    min_joints: int,
    min_sine: float,
    gate: float,
) -> Floats:
    """Return mean distances (n, n) [m] between the rays of two detections, in the upper triangle.

    Detections have camera centers (n, 3) [m], world, unit rays (n, joints, 3), NaN where not seen,
    camera indices (n,), and `places` (n, 3) [m], footprints. A distance is infinite where two
    cannot start a group: of the same camera, farther apart on the ground than their uncertainties,
    with less than `min_joints` in common, beyond the gate [m], or at a mean sine of angles below
    `min_sine`.
    """
    n, joint_count, _ = directions.shape
    distances = np.full((n, n), np.inf)
    for a in range(n):
        for b in range(a + 1, n):
            if camera[a] == camera[b]:
                continue
            reach = places[a, 2] + places[b, 2] + gate
            if math.hypot(places[a, 0] - places[b, 0], places[a, 1] - places[b, 1]) > reach:
                continue
            total, sines, count = rays_apart(
                centers[b] - centers[a], directions[a], directions[b], gate * joint_count
            )
            if count >= min_joints and sines >= min_sine * count and total <= gate * count:
                distances[a, b] = total / count
    return distances


def associate(
    centers: Floats,
    directions: Floats,
    weights: Floats,
    ground: bool,
    settings: TrackingSettings,
    gate: float | None = None,
) -> list[Sighting]:
    """Return the people in agreeing detections of at least `birth_views` cameras.

    The two nearest detections start a group; every other camera adds the detection nearest to their
    intersection. A group of too few views, or of impossible size, is no person; each detection
    joins one group at most.

    Centers (cameras, 3) [m] and unit rays (cameras, detections, 17, 3) are in the world; rays are
    NaN, and weights (cameras, detections, 17) of the squared angle are 0, where not seen or
    matched. `ground` is whether people stand on z = 0. The largest mean distance between the rays
    of two detections of one person is `gate` [m]; None = `epipolar_gate_m`.
    """
    cameras = len(centers)
    needed = settings.birth_views
    gate = settings.epipolar_gate_m if gate is None else gate
    usable = np.count_nonzero(weights > 0.0, axis=-1) >= settings.min_joints
    if np.count_nonzero(usable.any(axis=1)) < needed:
        return []
    camera, detection = np.nonzero(usable)
    origins, rays = centers[camera], directions[camera, detection]
    low, high = settings.body_heights_m
    extent = 0.5 * (high - low) if ground else math.inf
    places = footprints(origins, rays, (0.5 * (low + high), extent))
    least = settings.min_joints, math.sin(settings.min_angle_rad)
    distances = pair_distances(origins, rays, camera, places, *least, gate)
    first, second = np.nonzero(distances < np.inf)
    order = np.argsort(distances[first, second], kind="stable")
    free = np.where(usable[..., None], weights, 0.0)
    groups: list[Sighting] = []
    for a, b in zip(first[order], second[order], strict=True):
        if not (usable[camera[a], detection[a]] and usable[camera[b], detection[b]]):
            continue
        seed = np.full(cameras, -1)
        seed[camera[[a, b]]] = detection[[a, b]]
        group = _grow_group(seed, centers, directions, free, settings, gate)
        views = np.count_nonzero(group.index >= 0)
        if views >= needed and is_person(group.joints, ground, settings):
            groups.append(group)
            members = np.flatnonzero(group.index >= 0)
            usable[members, group.index[members]] = False
            free[members, group.index[members]] = 0.0
    return groups


def is_person(joints: Floats, ground: bool, settings: TrackingSettings) -> bool:
    """Return whether joints (17, 3) [m] have a person's size, and a person's height if `ground`."""
    known = np.isfinite(joints[:, 2])
    if not has_adult_size(joints, settings.size_range):
        return False
    low, high = settings.body_heights_m
    return not ground or low <= float(joints[known, 2].mean()) <= high


def _grow_group(
    index: Integers,
    centers: Floats,
    directions: Floats,
    weights: Floats,
    settings: TrackingSettings,
    last_gate: float,
) -> Sighting:
    """Return the group around a seed of two detections (cameras,).

    Two passes, the first at the wider gate: two views alone leave the position uncertain.
    """
    unknown = np.full((1, directions.shape[2], 3), np.nan)
    sine = math.sin(settings.min_angle_rad)
    for gate in (settings.gate_m, last_gate):
        joints = intersect_people(
            centers, directions, weights, index[:, None], unknown, settings.gate_m, sine
        )
        gates = np.full((len(centers), 1), gate)
        distances = -ray_affinity(joints, centers, directions, weights, gates, settings.min_joints)[
            :, 0
        ]
        best = distances.argmin(axis=1)
        ray_distance = distances[np.arange(len(centers)), best]
        index = np.where(ray_distance <= gate, best, -1)
    joints = intersect_people(
        centers, directions, weights, index[:, None], unknown, settings.gate_m, sine
    )
    return Sighting(index, np.where(index >= 0, ray_distance, np.nan), joints[0])
