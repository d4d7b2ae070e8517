"""Evidence for new people in exactly two cameras: the odds that both show one person.

Two rays nearly meet wherever two cameras look at people of one height, so a small distance between
rays is not enough. The odds of a pair weigh its rays' distance, the size and proportions of the
triangulated skeleton, cameras that should see a person there and have no detection, and all other
pairs that could contain one of the two detections.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.tracking.camera_statistics import CameraGates, CameraVisibility
from worldpose.tracking.epipolar import is_person, pair_distances, size_ratios
from worldpose.tracking.person import Sighting, separations
from worldpose.tracking.ray_matching import intersect_people
from worldpose.tracking.settings import TrackingSettings

SIZE_SPREAD: Final = 0.15
"""Standard deviation of the logarithm of a person's size from one frame [1]."""
LIMB_SCATTER: Final = 0.2
"""Standard deviation of the logarithms of limb lengths of one person in one frame [1]."""
SAME_PLACE: Final = 0.3
"""Two skeletons with a smaller mean joint distance are one body [m]."""
NO_PARTNER: Final = -6.3
"""Score of a detection without partner [nat]."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """All possible pairs of a frame's free detections.

    Attributes:
        cameras: (pairs, 2) indices of the two cameras, the first before the second.
        detections: (pairs, 2) indices of their detections.
        joints: (pairs, 17, 3) [m], world, from the intersection of their rays.
        distance: (pairs,) mean distance of their rays [m].
        odds: (pairs,) odds against all other explanations of the two detections [1].
        unique: (pairs,) whether the pair is likelier than all its rivals together.
    """

    cameras: Integers
    detections: Integers
    joints: Floats
    distance: Floats
    odds: Floats
    unique: Flags

    def find(self, index: Integers) -> int | None:
        """Return the number of the pair of two detections (cameras,), -1 = none; None if absent."""
        cameras = np.flatnonzero(index >= 0)
        same = (self.cameras == cameras) & (self.detections == index[cameras])
        found = np.flatnonzero(same.all(axis=1))
        return int(found[0]) if len(found) else None


def judge_pairs(
    directions: Floats,
    weights: Floats,
    visibility: CameraVisibility,
    gates: CameraGates,
    ground: bool,
    settings: TrackingSettings,
    *,
    everything: Floats,
) -> Pairs:
    """Return the odds of every pair of detections of two cameras.

    Args:
        directions: (cameras, detections, 17, 3) unit rays, world; NaN where not seen.
        weights: (cameras, detections, 17), of the squared angle; 0 where not seen, or where other
            views explain the detection.
        visibility: visibility statistics of the cameras.
        gates: distances between rays of one person; updated here.
        ground: whether people stand on z = 0.
        settings: gates and accepted sizes.
        everything: the weights of all detections, explained or not.
    """
    centers = visibility.centers
    usable = np.count_nonzero(weights > 0.0, axis=-1) >= settings.min_joints
    camera, detection = np.nonzero(usable)
    rays = directions[camera, detection]
    anywhere = np.tile([0.0, 0.0, np.inf], (len(camera), 1))
    distances = pair_distances(
        centers[camera],
        rays,
        camera,
        anywhere,
        settings.min_joints,
        math.sin(settings.min_angle_rad),
        settings.epipolar_gate_m,
    )
    first, second = np.nonzero(distances < np.inf)
    index = np.full((len(centers), len(first)), -1)
    number = np.arange(len(first))
    index[camera[first], number] = detection[first]
    index[camera[second], number] = detection[second]
    joints = intersect_people(
        centers,
        directions,
        weights,
        index,
        np.full((len(first), directions.shape[2], 3), np.nan),
        settings.gate_m,
        math.sin(settings.min_angle_rad),
    )
    keep = np.array([is_person(each, ground, settings) for each in joints], dtype=np.bool_)
    first, second, joints = first[keep], second[keep], joints[keep]
    distance = distances[first, second]
    gates.learn_pairs(distance[_mutually_nearest(first, second, distance, len(camera))])
    noise = gates.pair_noise(camera[first], camera[second])
    with np.errstate(invalid="ignore"):
        score = -0.5 * (distance / noise) ** 2 + _body_scores(joints)
    own = np.zeros((len(centers), len(first)), dtype=np.bool_)
    own[camera[first], np.arange(len(first))] = own[camera[second], np.arange(len(first))] = True
    score += visibility.misses_score(joints, directions, everything, own)
    likelihood, rivals = np.exp(score), _rival_likelihoods(first, second, joints, score)
    return Pairs(
        np.stack([camera[first], camera[second]], axis=-1),
        np.stack([detection[first], detection[second]], axis=-1),
        joints,
        distance,
        likelihood / (math.exp(NO_PARTNER) + rivals),
        likelihood >= rivals,
    )


def group_pairs(pairs: Pairs, weights: Floats, settings: TrackingSettings) -> list[Sighting]:
    """Return the pairs that are likelier than their rivals, the likeliest first.

    Args:
        pairs: of one frame.
        weights: (cameras, detections, 17); 0 for matched detections.
        settings: least number of joints.

    Note:
        Each detection joins one pair at most.
    """
    free = np.count_nonzero(weights > 0.0, axis=-1) >= settings.min_joints
    groups = []
    for n in np.argsort(-pairs.odds, kind="stable").tolist():
        camera, detection = pairs.cameras[n], pairs.detections[n]
        if not pairs.unique[n] or not free[camera, detection].all():
            continue
        free[camera, detection] = False
        index = np.full(len(weights), -1)
        index[camera] = detection
        distance = np.where(index >= 0, 0.5 * pairs.distance[n], np.nan)
        groups.append(Sighting(index, distance, pairs.joints[n]))
    return groups


def _mutually_nearest(
    first: Integers,
    second: Integers,
    distance: Floats,
    detections: int,
) -> Flags:
    """Return which pairs (pairs,) are the nearest of both their detections."""
    nearest = np.full(detections, np.inf)
    np.minimum.at(nearest, first, distance)
    np.minimum.at(nearest, second, distance)
    return np.asarray((distance <= nearest[first]) & (distance <= nearest[second]))


def _body_scores(joints: Floats) -> Floats:
    """Return log likelihoods (n,) [nat] of the size and proportions of joints (n, 17, 3) [m]."""
    size = np.log(size_ratios(joints))
    middle = np.nanmedian(size, axis=1)
    scatter = np.nanmean(np.square(size - middle[:, None]), axis=1)
    return np.asarray(-0.5 * (middle / SIZE_SPREAD) ** 2 - 0.5 * scatter / LIMB_SCATTER**2)


def _rival_likelihoods(
    first: Integers,
    second: Integers,
    joints: Floats,
    score: Floats,
) -> Floats:
    """Return the summed likelihood (pairs,) of each pair's rivals.

    A rival shares a detection and has its body elsewhere; a pair with a shared detection and the
    body at the same position is a duplicate detection of that body.
    """
    shared = (first[:, None] == first) | (second[:, None] == second)
    shared |= (first[:, None] == second) | (second[:, None] == first)
    np.fill_diagonal(shared, False)
    rival = shared & (separations(joints, joints) > SAME_PLACE)
    return np.asarray(np.where(rival, np.exp(score)[None], 0.0).sum(axis=1))
