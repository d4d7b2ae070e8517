"""Evidence for new people in exactly two cameras: the odds that both show one person.

Two rays nearly meet wherever two cameras look at people of one height, so a small distance between
rays is not enough. The odds of a pair weigh its rays' distance, the size and proportions of the
triangulated skeleton, cameras that should see a person there and have no detection, and all other
pairs that could contain one of the two detections.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.tracking.epipolar import is_person, pair_distances, size_ratios
from worldpose.tracking.person import Sighting, separations
from worldpose.tracking.ray_matching import intersect_people
from worldpose.tracking.settings import TrackingSettings

MAX_HISTORY: Final = 300
"""Most matched detections of a camera that its median distance uses."""
MIN_HISTORY: Final = 10
"""Least number of matches for a median."""


class CameraVisibility:
    """Expected visibility and misses of cameras, learned from known people.

    Attributes:
        centers: (cameras, 3) [m], world.
        reach: (cameras,) greatest distance of a person that the camera showed [m].
        shown: (cameras,) number of people that the camera should have shown [1].
        missed: (cameras,) number of these people without a detection [1].
    """

    def __init__(self, cameras: Camera) -> None:
        self.centers = np.ascontiguousarray(cameras.center)
        self._cameras = cameras
        count = len(self.centers)
        self.reach = np.zeros(count)
        self.shown, self.missed = np.zeros(count), np.zeros(count)

    def should_see(self, joints: Floats) -> Flags:
        """Return which cameras (cameras, n) should see bodies (n, 17, 3) [m].

        Most joints must be in the image, and the camera must have shown people at a similar
        distance. NaN joints do not count.
        """
        n, joint_count, _ = joints.shape
        image = self._cameras.project(joints.reshape(-1, 3)).reshape(-1, n, joint_count, 2)
        size = self._cameras.image_size[:, None, None]
        with np.errstate(invalid="ignore"):
            inside = ((image >= 0.0) & (image <= size)).all(axis=-1).sum(axis=-1)
        known = np.isfinite(joints[..., 0]).sum(axis=1)
        away = np.linalg.norm(np.nanmean(joints, axis=1) - self.centers[:, None], axis=-1)
        near = away <= 1.25 * self.reach[:, None]
        return np.asarray((inside >= 0.8 * known) & (known > 0) & near)

    def learn(self, joints: Floats, directions: Floats, weights: Floats, seen: Flags) -> None:
        """Update with known people of a frame, whom cameras have `seen` (cameras, n) or not.

        Joints (n, 17, 3) [m], world, are NaN where unknown; unit rays (cameras, detections, 17, 3)
        are NaN, and weights (cameras, detections, 17) are 0, where not seen.
        """
        away = np.linalg.norm(np.nanmean(joints, axis=1) - self.centers[:, None], axis=-1)
        self.reach = np.maximum(self.reach, np.where(seen, away, 0.0).max(axis=1, initial=0.0))
        expected = self.should_see(joints)
        self.shown += expected.sum(axis=1)
        empty = expected & ~seen
        if empty.any():
            empty = find_uncovered_bodies(empty, joints, self.centers, directions, weights)
            self.missed += empty.sum(axis=1)

    def misses_score(
        self, joints: Floats, directions: Floats, weights: Floats, own: Flags
    ) -> Floats:
        """Return the log probability (n,) that cameras miss bodies which they should see.

        A camera that cannot see the position adds nothing, and neither does one with a detection
        there, which may occlude the body. `own` (cameras, n) are the cameras whose detections the
        body is from; other arguments are as of `learn`.
        """
        if not len(joints):
            return np.zeros(0)
        empty = self.should_see(joints) & ~own
        if empty.any():
            empty = find_uncovered_bodies(empty, joints, self.centers, directions, weights)
        rate = np.log((self.missed + 1.0) / (self.shown + 2.0))
        return np.asarray(np.where(empty, rate[:, None], 0.0).sum(axis=0))


@compile_kernel
def find_uncovered_bodies(
    asked: Flags, joints: Floats, centers: Floats, directions: Floats, weights: Floats
) -> Flags:
    """Return in which of the asked cameras no detection lies on the image of bodies (cameras, n).

    `asked` (cameras, n) are those to look at; the result is False elsewhere. Joints are (n, 17, 3)
    [m], world, NaN where unknown; cameras have centers (cameras, 3) [m], world, unit rays (cameras,
    detections, 17, 3), NaN where not seen, and weights (cameras, detections, 17), 0 where not seen.
    """
    cameras, detections, count, _ = directions.shape
    uncovered = asked.copy()
    for c in range(cameras):
        for body in range(len(joints)):
            if not asked[c, body]:
                continue
            for detection in range(detections):
                on = 0
                for k in range(count):
                    if not weights[c, detection, k] > 0.0:
                        continue
                    u, v, w = directions[c, detection, k]
                    for joint in range(len(joints[body])):
                        if math.isnan(joints[body, joint, 0]):
                            continue
                        x = joints[body, joint, 0] - centers[c, 0]
                        y = joints[body, joint, 1] - centers[c, 1]
                        z = joints[body, joint, 2] - centers[c, 2]
                        along = x * u + y * v + z * w
                        # A ray that passes a joint within this distance is on the body [m].
                        if along > 0.0 and x * x + y * y + z * z - along**2 <= 0.2**2:
                            on += 1
                            break
                # Keypoints on a body's image from which on a camera has a detection there [1].
                if on >= 4:
                    uncovered[c, body] = False
                    break
    return uncovered


class CameraGates:
    """Distances of each camera's detections to the people that they were matched with.

    `usual` (cameras,) are medians [m], and `usual_pair` is the median distance of the rays of two
    detections that are each other's nearest [m]; infinite with too few.
    """

    def __init__(self, cameras: int) -> None:
        self.usual = np.full(cameras, np.inf)
        self.usual_pair = np.inf
        self._pairs: deque[float] = deque(maxlen=MAX_HISTORY)
        self._known = np.full((cameras, MAX_HISTORY), np.nan)
        self._count = np.zeros(cameras, dtype=np.int64)

    def learn(self, distance: Floats) -> None:
        """Add the ray distances (cameras, persons) [m] of a frame's matches; NaN = none."""
        _append(distance, self._known, self._count)
        is_full = self._count >= MAX_HISTORY
        if is_full.any():
            # As `np.median`, which takes three times as long.
            middle = [(MAX_HISTORY - 1) // 2, MAX_HISTORY // 2]
            ordered = np.partition(self._known[is_full], middle, axis=1)
            self.usual[is_full] = 0.5 * (ordered[:, middle[0]] + ordered[:, middle[1]])
        for camera in np.flatnonzero((self._count >= MIN_HISTORY) & ~is_full).tolist():
            self.usual[camera] = np.median(self._known[camera, : self._count[camera]])

    def learn_pairs(self, distance: Floats) -> None:
        """Add ray distances (pairs,) [m] of detections that are each other's nearest."""
        self._pairs.extend(distance.tolist())
        if len(self._pairs) >= MIN_HISTORY:
            self.usual_pair = float(np.median(self._pairs))

    def pair_noise(self, first: Integers, second: Integers) -> Floats:
        """Return the standard deviation of the distance of two cameras' rays (n,) [m]."""
        low, unknown, high = 0.03, 0.05, 0.13  # MVOR's median is 0.05 m, Shelf's 0.02 m
        usual = 1.4 * np.hypot(self.usual[first], self.usual[second])
        usual = np.where(np.isfinite(usual), usual, self.usual_pair)
        # The median of Rayleigh's distribution is 1.18 times its scale.
        return np.asarray(np.where(np.isfinite(usual), np.clip(0.85 * usual, low, high), unknown))


@compile_kernel
def _append(distance: Floats, known: Floats, count: Integers) -> None:
    """Write finite distances (cameras, persons) [m] behind the last ones; the oldest give way.

    `known` (cameras, n) [m], the last n of each camera, is written in turn; `count` (cameras,)
    grows.
    """
    for camera in range(len(known)):
        for person in range(distance.shape[1]):
            if np.isfinite(distance[camera, person]):
                known[camera, count[camera] % known.shape[1]] = distance[camera, person]
                count[camera] += 1


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
        weights: (cameras, detections, 17), of the squared angle.
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
        # Score of a detection without partner [nat].
        likelihood / (math.exp(-6.3) + rivals),
        likelihood >= rivals,
    )


def group_pairs(
    pairs: Pairs, weights: Floats, settings: TrackingSettings, least_odds: float = 0.0
) -> list[Sighting]:
    """Return the pairs that are likelier than their rivals, the likeliest first.

    Each detection joins one pair at most. Weights (cameras, detections, 17) are 0 for matched
    detections; a pair counts from odds of `least_odds` [1].
    """
    free = np.count_nonzero(weights > 0.0, axis=-1) >= settings.min_joints
    groups = []
    for n in np.argsort(-pairs.odds, kind="stable").tolist():
        camera, detection = pairs.cameras[n], pairs.detections[n]
        if not pairs.unique[n] or pairs.odds[n] < least_odds or not free[camera, detection].all():
            continue
        free[camera, detection] = False
        index = np.full(len(weights), -1)
        index[camera] = detection
        distance = np.where(index >= 0, 0.5 * pairs.distance[n], np.nan)
        groups.append(Sighting(index, distance, pairs.joints[n]))
    return groups


def _mutually_nearest(
    first: Integers, second: Integers, distance: Floats, detections: int
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
    # Standard deviations of the logarithms of a person's size and limb lengths in one frame.
    return np.asarray(-0.5 * (middle / 0.15) ** 2 - 0.5 * scatter / 0.2**2)


def _rival_likelihoods(first: Integers, second: Integers, joints: Floats, score: Floats) -> Floats:
    """Return the summed likelihood (pairs,) of each pair's rivals.

    A rival shares a detection and has its body elsewhere; a pair with a shared detection and the
    body at the same position is a duplicate detection of that body.
    """
    shared = (first[:, None] == first) | (second[:, None] == second)
    shared |= (first[:, None] == second) | (second[:, None] == first)
    np.fill_diagonal(shared, False)
    # Two skeletons with a smaller mean joint distance are one body [m].
    rival = shared & (separations(joints, joints) > 0.3)
    return np.asarray(np.where(rival, np.exp(score)[None], 0.0).sum(axis=1))
