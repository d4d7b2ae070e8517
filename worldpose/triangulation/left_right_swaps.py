"""Left-right swaps: detections that fit the other views only with left and right swapped."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.compiled import compile_kernel
from worldpose.geometry.projection import project_point
from worldpose.triangulation.observations import Observations
from worldpose.triangulation.solving import Solution

PAIRS: Final = np.array(
    [
        (COCO17.index(f"left_{name}"), COCO17.index(f"right_{name}"))
        for names in EXCHANGED_PARTS.values()
        for name in names
    ]
)
"""(pairs, 2) left and right joints, part by part."""
PART_OF: Final = np.repeat(
    np.arange(len(EXCHANGED_PARTS)), [len(names) for names in EXCHANGED_PARTS.values()]
)
"""(pairs,) part of each pair."""
POINT_PARTS: Final = {
    **dict.fromkeys(("toe", "heel", "thigh", "shank", "foot"), "legs"),
    **dict.fromkeys(("upper_arm", "forearm"), "arms"),
    "head": "face",
}
"""Part of the body that a point besides COCO-17 belongs to, by a word in its name; others are of
the trunk, and swapped with arms and legs together."""
WHOLE: Final = 2.0 * math.log(50.0)
"""Twice the logarithm of the prior odds against a left-right swap of the whole body: detectors
mistake one back in fifty for a front. Half or one and a half times as much changes mean errors by
0.1 %."""
PART: Final = 2.0 * math.log(150.0)
"""The same for a single part."""


def find_swaps(
    observations: Observations,
    noise: tuple[float, float],
    limit: float,
    found: Solution,
) -> Flags:
    """Return the left-right swaps of body parts (frames, cameras, persons, parts).

    Each detection is compared, as it is and with the whole body or parts of it swapped, by the
    distances to the joints from all views, under a loss truncated at `limit`. Only detections with
    at least two outlier keypoints are tested.

    Args:
        observations: observations of all tracked people.
        noise: [px], [m].
        limit: largest squared error of an inlier [variances].
        found: the joints from the unchanged detections.
    """
    exchanged = np.zeros((*observations.detection_index.shape, len(EXCHANGED_PARTS)), np.bool_)
    if observations.precision.shape[-1] == len(COCO17):
        _find_swaps(observations, noise, limit, found, PAIRS, PART_OF, exchanged)
    return exchanged


def undo_swaps(detections: KeypointDetections, exchanged: Flags) -> KeypointDetections:
    """Return detections with left-right swaps undone, also of the points besides COCO-17.

    Args:
        detections: detections before any correction; not changed.
        exchanged: (frames, cameras, persons, parts).
    """
    if not exchanged.any():
        return detections
    keypoints, confidence = detections.keypoints.copy(), detections.confidence.copy()
    for part in range(exchanged.shape[-1]):
        frame, camera, person = np.nonzero(exchanged[..., part])
        detection = detections.detection_index[frame, camera, person]
        place = tuple(each[:, None] for each in (frame, camera, detection))
        of_part = PAIRS[part == PART_OF]
        for right, seen in ((keypoints, detections.keypoints), (confidence, detections.confidence)):
            right[(*place, of_part.ravel())] = seen[(*place, of_part[:, ::-1].ravel())]
    swapped = replace(detections, keypoints=keypoints, confidence=confidence)
    if detections.extra_keypoints is None or detections.extra_confidence is None:
        return swapped
    points = detections.points
    extra, sure = detections.extra_keypoints.copy(), detections.extra_confidence.copy()
    names = list(EXCHANGED_PARTS)
    limbs = exchanged[..., [names.index(part) for part in ("arms", "legs")]].all(axis=-1)
    for name in (*names, ""):
        of_part = _point_pairs(points, name)
        its = exchanged[..., names.index(name)] if name else limbs
        frame, camera, person = np.nonzero(its)
        detection = detections.detection_index[frame, camera, person]
        place = tuple(each[:, None] for each in (frame, camera, detection))
        for right, seen in (
            (extra, detections.extra_keypoints),
            (sure, detections.extra_confidence),
        ):
            right[(*place, of_part.ravel())] = seen[(*place, of_part[:, ::-1].ravel())]
    return swapped.add_points(points, extra, sure)


def _point_pairs(points: tuple[str, ...], part: str) -> NDArray[np.int64]:
    """Return left and right points (pairs, 2) of a part; those of the trunk without a name."""
    pairs = [
        (place, points.index(mirrored))
        for place, point in enumerate(points)
        if point.startswith("left_")
        and (mirrored := point.replace("left_", "right_", 1)) in points
        and part == next((its for word, its in POINT_PARTS.items() if word in point), "")
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


@compile_kernel
def _find_swaps(
    observations: Observations,
    noise: tuple[float, float],
    limit: float,
    found: Solution,
    pairs: NDArray[np.int64],
    part_of: NDArray[np.int64],
    exchanged: Flags,
) -> None:
    """Write `exchanged` (frames, cameras, persons, parts)."""
    keypoints, precision = observations.keypoints, observations.precision
    index, shift, cameras = observations.detection_index, observations.shift, observations.cameras
    joints, covariance = found.joints, found.covariance
    seen, inliers = found.seen, found.inliers
    frames, count, persons = index.shape
    joint_count = precision.shape[3]
    image, base, doubt = np.empty((2, 2)), np.empty(2), np.empty(2)
    gain = np.empty(exchanged.shape[3])
    for t in range(frames):
        for c in range(count):
            camera = cameras[c]
            for n in range(persons):
                detection = index[t, c, n]
                if detection < 0:
                    continue
                rejected = 0
                for joint in range(joint_count):
                    known = not math.isnan(joints[t, n, joint, 0])
                    rejected += known and seen[t, c, n, joint] and not inliers[t, c, n, joint]
                if rejected < 2:
                    continue
                u, v, extra = 0.0, 0.0, 0.0
                if len(shift):
                    u, v, extra = shift[t, c, n]
                gain[:] = 0.0
                for k in range(len(pairs)):
                    for side in range(2):
                        joint = pairs[k, side]
                        x, y, z = joints[t, n, joint]
                        at = project_point(camera, x, y, z)
                        image[side, 0] = camera[0] * at[1] + camera[2]
                        image[side, 1] = camera[1] * at[2] + camera[3]
                        size = camera[0] * camera[1] / at[5] ** 2 if at[0] == 0 else math.nan
                        base[side] = noise[0] ** 2 + size * noise[1] ** 2
                        trace = covariance[t, n, joint, 0, 0] + covariance[t, n, joint, 1, 1]
                        doubt[side] = size * (trace + covariance[t, n, joint, 2, 2]) / 3.0 + extra
                    if math.isnan(doubt[0] + doubt[1]):
                        continue
                    for side in range(2):
                        g = precision[t, c, detection, pairs[k, side]]
                        if not 0.0 < g < math.inf:
                            continue
                        a = keypoints[t, c, detection, pairs[k, side], 0] - u
                        b = keypoints[t, c, detection, pairs[k, side], 1] - v
                        if not abs(a) + abs(b) < math.inf:
                            continue
                        for target in range(2):
                            square = (a - image[target, 0]) ** 2 + (b - image[target, 1]) ** 2
                            square = min(limit, square / (base[target] / g + doubt[target]))
                            gain[part_of[k]] += square if target == side else -square
                parts = 0.0
                for part in range(len(gain)):
                    parts += max(0.0, gain[part] - PART)
                whole = gain.sum() - WHOLE
                for part in range(len(gain)):
                    all_of_it = whole > 0.0 and whole >= parts
                    exchanged[t, c, n, part] = all_of_it or gain[part] > PART
