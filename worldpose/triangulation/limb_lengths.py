"""Repairs of detector errors: left-right swaps, and joints from a wrong pair of views.

A swapped detection fits the other views only with left and right exchanged.

If one of three views is wrong, any two may agree about equally well. The correct pair preserves the
person's limb lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats
from data_contracts.conventions import COCO17, COCO17_LIMBS
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.compiled import compile_kernel
from worldpose.geometry import camera_model
from worldpose.geometry.camera_model import project_point
from worldpose.geometry.lens_models import load_camera
from worldpose.triangulation.residuals import Observations
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solve import SolvedJoints, solve_joints

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
    observations: Observations, noise: tuple[float, float], limit: float, found: SolvedJoints
) -> Flags:
    """Return the left-right swaps of body parts (frames, cameras, persons, parts).

    Each detection is compared, as it is and with the whole body or parts of it swapped, by the
    distances to the joints from all views, under a loss truncated at the largest squared error of
    an inlier, `limit` [variances]. Only detections with at least two outlier keypoints are tested.
    `noise` is [px], [m], and `found` has the joints from the unchanged detections.
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
    joints = detections.keypoints.copy(), detections.confidence.copy()
    for part in range(exchanged.shape[-1]):
        _swap(joints, detections.detection_index, exchanged[..., part], PAIRS[part == PART_OF])
    swapped = replace(detections, keypoints=joints[0], confidence=joints[1])
    if detections.extra_keypoints is None or detections.extra_confidence is None:
        return swapped
    extra = detections.extra_keypoints.copy(), detections.extra_confidence.copy()
    names = list(EXCHANGED_PARTS)
    limbs = exchanged[..., [names.index(part) for part in ("arms", "legs")]].all(axis=-1)
    for name in (*names, ""):
        its = exchanged[..., names.index(name)] if name else limbs
        pairs = _point_pairs(detections.points, name)
        _swap(extra, detections.detection_index, np.asarray(its), pairs)
    return swapped.add_points(detections.points, *extra)


def _swap(
    arrays: tuple[AnyFloats, ...], index: NDArray[np.integer], its: Flags, pairs: NDArray[np.int64]
) -> None:
    """Swap pairs (pairs, 2) of keypoints in place, of the detections of marked people."""
    frame, camera, person = np.nonzero(its)
    place = frame[:, None], camera[:, None], index[frame, camera, person][:, None]
    for array in arrays:
        array[(*place, pairs.ravel())] = array[(*place, pairs[:, ::-1].ravel())]


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
    found: SolvedJoints,
    pairs: NDArray[np.int64],
    part_of: NDArray[np.int64],
    exchanged: Flags,
) -> None:
    """Write `exchanged` (frames, cameras, persons, parts)."""
    keypoints, precision = observations.keypoints, observations.precision
    index, shift = observations.detection_index, observations.shift
    cameras = observations.rig.cameras
    joints, covariance = found.joints, found.covariance
    seen, inliers = found.seen, found.inliers
    frames, count, persons = index.shape
    joint_count = precision.shape[3]
    image, base, doubt = np.empty((2, 2)), np.empty(2), np.empty(2)
    gain = np.empty(exchanged.shape[3])
    for t in range(frames):
        for c in range(count):
            camera = load_camera(cameras, c)
            area = camera.fx * camera.fy
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
                        status, image[side, 0], image[side, 1], depth = project_point(
                            camera, x, y, z
                        )
                        size = area / depth**2 if status == 0 else math.nan
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


SURE: Final = 3
"""Inlier views that both ends of a measured limb need; an end with no more may be accidental."""
SLACK: Final = 0.03
"""Standard deviation of a limb's length from frame to frame [m]: the label of a hip means another
point from behind than from the side."""
STRANGE: Final = 4.0
"""Squared deviation of a length from which other pairs are tried [variances]."""


def limb_lengths(found: SolvedJoints) -> Floats:
    """Return the limb lengths of all persons (persons, limbs) [m]; NaN where unknown.

    A length is the median over the frames with three inlier views of both ends, or over all frames
    if those are too few. The length is unknown if it varies too much.
    """
    fewest = 5  # minimum frames to measure the length of a limb
    persons, joints = found.joints.shape[1:3]
    lengths = np.full((persons, len(COCO17_LIMBS)), np.nan)
    if joints != len(COCO17):
        return lengths
    for number, (upper, lower) in enumerate(COCO17_LIMBS):
        there = np.linalg.norm(found.joints[:, :, upper] - found.joints[:, :, lower], axis=-1)
        sure = np.minimum(found.views[:, :, upper], found.views[:, :, lower]) >= SURE
        for person in range(persons):
            known = there[:, person][sure[:, person]]
            if len(known) < fewest:
                known = there[:, person][np.isfinite(there[:, person])]
            if len(known) < fewest:
                continue
            usual = np.median(known)
            if np.median(np.abs(known - usual)) <= SLACK:
                lengths[person, number] = usual
    return lengths


def repair_limb_lengths(
    observations: Observations,
    settings: TriangulationSettings,
    found: SolvedJoints,
    lengths: Floats,
) -> None:
    """Re-triangulate, in place, ends with few inlier views of limbs of wrong length.

    For the two limbs of an arm or leg together, the pairs of views with the smallest residuals of
    all views and limb lengths (persons, limbs) [m] decide. If the limb still has a wrong length,
    its end is missing. `found` has the joints of the same observations.
    """
    if found.joints.shape[2] != len(COCO17):
        return
    for number, (upper, middle) in enumerate(COCO17_LIMBS):
        if number % 4 > 1:
            continue
        chain = (upper, middle, COCO17_LIMBS[number + 2][1])
        long = lengths[:, number : number + 4 : 2]
        views = found.views[:, :, chain[1:]]
        seen = found.seen[..., chain[1:]].sum(axis=1)
        few = (views > 0) & ((views <= SURE) | (2 * views <= seen))
        ends = [
            _Points(found.joints[:, :, joint], found.covariance[:, :, joint]) for joint in chain
        ]
        first, second = (_deviation(ends[n], ends[n + 1], long[:, n])[0] for n in (0, 1))
        strange = few[..., 0] & ((first > STRANGE) | (second > STRANGE))
        strange |= few[..., 1] & (second > STRANGE)
        for frame, person in np.argwhere(strange):
            choices = []
            for joint, doubtful in zip(chain[1:], few[frame, person], strict=True):
                views_of_end = _select_end(observations, found, (frame, person, joint), doubtful)
                choices.append(_list_choices(views_of_end, settings, found, (frame, person, joint)))
            root = _Points(ends[0].position[frame, person], ends[0].covariance[frame, person])
            limit = settings.max_deviation**2
            _choose(root, choices, long[person], limit, found, (frame, person, *chain[1:]))


@dataclass(frozen=True, eq=False)
class _Points:
    """Points [m] (..., 3), world, and their covariance [m^2] (..., 3, 3)."""

    position: Floats
    covariance: Floats


def _select_end(
    observations: Observations, found: SolvedJoints, end: tuple[int, int, int], doubtful: bool
) -> Observations:
    """Return one limb end's observations: one frame, one detection per camera, one joint."""
    frame, person, joint = end
    which = np.maximum(observations.detection_index[frame, :, person], 0)
    place = (frame, np.arange(len(which)), which, joint)
    there = found.seen[frame, :, person, joint] & doubtful
    weights = np.where(there, observations.precision[place], 0.0)
    shift = observations.shift
    return observations._replace(
        keypoints=observations.keypoints[place][None, :, None, None],
        precision=weights[None, :, None, None],
        detection_index=np.zeros((1, len(weights), 1), np.int64),
        shift=shift[frame : frame + 1, :, person : person + 1] if len(shift) else shift,
    )


@dataclass(frozen=True, eq=False)
class _Choices:
    """Candidate positions of a limb's end.

    Attributes:
        points: (choices,).
        cost: (choices,) cost of the residuals of all views.
        tried: the solution of each; None for an end that stays.
    """

    points: _Points
    cost: Floats
    tried: SolvedJoints | None


def _list_choices(
    observations: Observations,
    settings: TriangulationSettings,
    found: SolvedJoints,
    end: tuple[int, int, int],
) -> _Choices:
    """Return the positions of an end from pairs of views and their inliers."""
    weights = observations.precision[0, :, 0, 0]
    pairs = np.array(list(combinations(np.flatnonzero(weights > 0.0), 2)))
    if not len(pairs):
        here = _Points(found.joints[end][None], found.covariance[end][None])
        return _Choices(here, np.zeros(1), None)
    used = np.zeros((len(pairs), len(weights)), np.bool_)
    np.put_along_axis(used, pairs, values=True, axis=1)
    repeated = observations._replace(
        keypoints=np.repeat(observations.keypoints, len(pairs), axis=0),
        shift=np.repeat(observations.shift, len(pairs), axis=0),
        detection_index=np.zeros((*used.shape, 1), np.int64),
    )

    def solve_from(views: NDArray[np.bool_]) -> tuple[SolvedJoints, Floats]:
        some = np.where(views, weights, 0.0)[:, :, None, None]
        solution = solve_joints(repeated._replace(precision=some), settings)
        return solution, _misfit(observations, settings.noise, solution.joints[:, 0, 0])

    limit = settings.max_deviation**2
    _, misfit = solve_from(used)
    tried, misfit = solve_from(misfit <= limit)
    # Rejecting a view of low precision costs less.
    some = np.where(weights > 0.0, weights, 1.0)
    most = np.maximum(limit + 2.0 * np.log(some / weights.max()), 0.0)
    cost = np.where(misfit <= limit, np.minimum(misfit, most), most)
    total = np.where(tried.views[:, 0, 0] > 0, cost[:, weights > 0.0].sum(axis=1), np.inf)
    return _Choices(_Points(tried.joints[:, 0, 0], tried.covariance[:, 0, 0]), total, tried)


def _choose(
    root: _Points,
    choices: list[_Choices],
    long: Floats,
    limit: float,
    found: SolvedJoints,
    chain: tuple[int, int, int, int],
) -> None:
    """Set the two ends of an arm or a leg to their best candidates, in place."""
    middle, end = choices
    first, sure = _deviation(root, middle.points, long[0])
    each_middle = _Points(middle.points.position[:, None], middle.points.covariance[:, None])
    second, known = _deviation(each_middle, end.points, long[1])
    cost = (middle.cost + np.minimum(first, limit) + sure)[:, None] + end.cost
    cost = cost + np.minimum(second, limit) + known
    if not np.isfinite(cost).any():
        return
    one, other = np.unravel_index(int(cost.argmin()), cost.shape)
    frame, person, *joints = chain
    for joint, choice, best, off in (
        (joints[0], middle, one, first[one]),
        (joints[1], end, other, second[one, other]),
    ):
        here = (frame, person, joint)
        views = (frame, slice(None), person, joint)
        if choice.tried is None:
            continue
        alone = choice.tried.views[best, 0, 0] < SURE
        # The same, from which an end with only two views is dropped: one correct end in a hundred.
        if off > (6.6 if alone else limit):
            found.joints[here], found.covariance[here] = np.nan, np.nan
            found.views[here], found.inliers[views] = 0, False
            found.spread[here] = found.reprojection_error[here] = np.nan
        else:
            there = (best, 0, 0)
            found.joints[here] = choice.points.position[best]
            found.covariance[here] = choice.points.covariance[best]
            found.views[here] = choice.tried.views[there]
            found.spread[here] = choice.tried.spread[there]
            found.reprojection_error[here] = choice.tried.reprojection_error[there]
            found.inliers[views] = choice.tried.inliers[best, :, 0, 0]


def _deviation(upper: _Points, lower: _Points, long: Floats | float) -> tuple[Floats, Floats]:
    """Return deviations of limbs from their lengths, and their variances."""
    limb = lower.position - upper.position
    now = np.linalg.norm(limb, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = limb / now[..., None]
        both = upper.covariance + lower.covariance
        variance = SLACK**2 + np.einsum("...i,...ij,...j", along, both, along)
        square = (now - long) ** 2 / variance
    known = np.isfinite(square)
    spread = np.log(np.where(known, variance, SLACK**2) / SLACK**2)
    return np.where(known, square, 0.0), spread


def _misfit(observations: Observations, noise: tuple[float, float], points: Floats) -> Floats:
    """Return squared errors of views (points, cameras) [variances]; 0 without an observation."""
    pixels, weights = observations.keypoints[0, :, 0, 0], observations.precision[0, :, 0, 0]
    cameras, depths, _ = observations.rig
    shift = observations.shift
    at = np.broadcast_to(points, (len(weights), *points.shape))
    image = np.empty((*at.shape[:-1], 2))
    camera_model.project(cameras, np.ascontiguousarray(at), image)
    depth = at @ depths[:, :3, None] + depths[:, 3, None, None]
    size = np.prod(cameras[:, :2], axis=1)[:, None] / depth[..., 0] ** 2
    moved = shift[0, :, 0] if len(shift) else np.zeros((len(weights), 3))
    error = image - (pixels - moved[:, :2])[:, None]
    seen = weights > 0.0
    variance = (noise[0] ** 2 + size * noise[1] ** 2) / np.where(seen, weights, 1.0)[:, None]
    square = np.square(error).sum(axis=-1) / (variance + moved[:, 2:])
    square = np.where(depth[..., 0] > 0.0, square, np.inf)
    square = np.where(np.isfinite(points[:, 0]), square, np.inf)
    return np.asarray(np.where(seen[:, None], square, 0.0).T)
