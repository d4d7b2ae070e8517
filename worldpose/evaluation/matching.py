"""Matches of predicted to true people per frame and per track, and identity metrics of tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.records import Record
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_iou
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Similarity, align

HOTA_LEVELS: Final = np.arange(1, 20) / 20.0
"""Similarity thresholds from 0.05 to 0.95 that HOTA averages over."""


class EvaluationSettings(Record):
    """Thresholds for matches, correct limbs and visible joints."""

    match_gate_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Maximum mean joint distance of matched persons [m]: more than the error of a poor
    reconstruction, less than the distance between two players without contact."""
    pcp_alpha: float = Field(default=0.5, ge=1e-6, le=100)
    """Maximum mean error of a correct limb's ends, as a share of its length [1]: the value of the
    published PCP3D results."""
    min_views: int = Field(default=2, ge=1, le=1000)
    """Minimum cameras that see a true joint for it to count [1]: one view does not determine depth.
    Applies if the truth has `views`."""
    min_joint_share: float = Field(default=0.5, ge=1e-6, le=1)
    """Minimum share of counting joints for a true person to count in a frame [1]: half a person at
    the border of all images is no false negative."""
    min_overlap: float = Field(default=0.5, ge=1e-6, le=1)
    """Minimum intersection over union of matched boxes [1]; the usual value, since the paper gives
    none."""
    min_aligned_joints: int = Field(default=7, ge=3, le=1000)
    """Minimum joints, of 14, of a person in a frame for PA-MPJPE [1]: alignment to a few joints
    removes most of their error, and half a body hides the error of the other half."""
    min_trajectory_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Minimum true path length of people for the drift [m]: the drift per metre of a standing
    goalkeeper is arbitrary."""
    min_matched_share: float = Field(default=0.5, ge=0, le=1)
    """Minimum share of matched people without registration [1]; below, the evaluation assumes that
    the prediction has its own world, and registers it before it matches tracks."""


@dataclass(frozen=True)
class IdentityScores:
    """Identity scores over time; None without people on both sides."""

    idf1: float | None
    """[0..1]"""
    hota: float | None
    """[0..1]"""
    detection_accuracy: float | None
    """[0..1]"""
    association_accuracy: float | None
    """[0..1]"""
    switches: int | None
    fragmentations: int | None


def identity_scores(
    distances: Floats, true_exists: Flags, predicted_exists: Flags, gate: float
) -> IdentityScores:
    """Return the identity scores of predicted tracks against true people.

    `distances` (frames, true, predicted persons) [m] are infinite where either is absent; `gate`
    [m] is the maximum of a match. IDF1: Ristani et al., ECCV-W 2016. Switches and fragmentations:
    Bernardin and Stiefelhagen, 2008, as counted by MOTChallenge. HOTA: Luiten et al., IJCV 2021.
    """
    both = true_exists[:, :, None] & predicted_exists[:, None, :]
    distances = np.where(both, distances, np.inf)
    people = int(true_exists.sum() + predicted_exists.sum())
    if not people:
        return IdentityScores(None, None, None, None, None, None)
    switches, fragmentations = _interruptions(distances, true_exists, gate)
    together = (distances <= gate).sum(axis=0)
    idf1 = 2.0 * together[linear_sum_assignment(-together)].sum() / people
    # A prediction at the gate has similarity 0, like a missing one.
    similarity = np.maximum(0.0, 1.0 - distances / gate)
    detection, association = _hota_parts(similarity, true_exists, predicted_exists)
    return IdentityScores(
        idf1=float(idf1),
        hota=float(np.sqrt(detection * association).mean()),
        detection_accuracy=float(detection.mean()),
        association_accuracy=float(association.mean()),
        switches=switches,
        fragmentations=fragmentations,
    )


def _interruptions(distances: Floats, true_exists: Flags, gate: float) -> tuple[int, int]:
    """Return the numbers of switches and fragmentations.

    In every frame, true people keep the prediction of the frame before while it is within the
    gate; the Hungarian method matches the others.
    """
    _, true, predicted = distances.shape
    people = np.arange(true)
    kept = np.full(true, -1)
    last = np.full(true, -1)
    lost = np.zeros(true, dtype=bool)
    switches = fragmentations = 0
    if not predicted:
        return 0, 0
    for distance, exists in zip(distances, true_exists, strict=True):
        keeps = (kept >= 0) & (distance[people, kept] <= gate)
        match = np.where(keeps, kept, -1)
        open_pairs = distance.copy()
        open_pairs[keeps] = np.inf
        open_pairs[:, kept[keeps]] = np.inf
        rows, columns = linear_sum_assignment(np.minimum(open_pairs, gate))
        good = open_pairs[rows, columns] <= gate
        match[rows[good]] = columns[good]
        matched = match >= 0
        switches += int((matched & (last >= 0) & (match != last)).sum())
        fragmentations += int((matched & lost).sum())
        lost = np.where(matched, False, lost | (exists & (last >= 0)))
        last = np.where(matched, match, last)
        kept = match
    return switches, fragmentations


def _hota_parts(
    similarity: Floats, true_exists: Flags, predicted_exists: Flags
) -> tuple[Floats, Floats]:
    """Return detection and association accuracy at every level (levels,)."""
    true_count, predicted_count = true_exists.sum(0), predicted_exists.sum(0)
    either = similarity.sum(-1, keepdims=True) + similarity.sum(-2, keepdims=True) - similarity
    shared = np.divide(similarity, either, out=np.zeros_like(similarity), where=either > 0.0).sum(0)
    total = true_count[:, None] + predicted_count
    alike = np.divide(shared, total - shared, out=np.zeros(shared.shape), where=total > shared)
    matches = np.zeros((len(HOTA_LEVELS), *shared.shape))
    for frame in similarity:
        rows, columns = linear_sum_assignment(-alike * frame)
        # The tolerance lets a similarity that equals a level up to rounding reach it.
        matches[:, rows, columns] += frame[rows, columns] >= HOTA_LEVELS[:, None] - 1e-12
    found = matches.sum((-1, -2))
    detection = found / (true_count.sum() + predicted_count.sum() - found)
    jaccard = matches / np.maximum(total - matches, 1.0)
    association = (matches * jaccard).sum((-1, -2)) / np.maximum(found, 1.0)
    return detection, association


def joint_boxes(joints: Floats, camera: Camera) -> Floats:
    """Return boxes around projected joints (frames, persons, 4) x0 y0 x1 y1 [px].

    Joints are (frames, persons, joints, 3) [m], world, NaN where missing; there is one camera, or
    one per frame. A box is NaN where no joint is in front of it, and not clipped to the image.
    """
    frames, persons, count, _ = joints.shape
    image = camera.project(joints.reshape(frames, persons * count, 3))
    image = image.reshape(frames, persons, count, 2)
    known = np.isfinite(image)
    low = np.where(known, image, np.inf).min(axis=-2, initial=np.inf)
    high = np.where(known, image, -np.inf).max(axis=-2, initial=-np.inf)
    boxes = np.concatenate([low, high], axis=-1)
    return np.where(np.isfinite(boxes), boxes, np.nan)


def box_overlaps(predicted: Floats, true: Floats) -> Floats:
    """Return intersection over union of all pairs (frames, true, predicted) [0..1].

    Boxes are (frames, persons, 4) x0 y0 x1 y1 [px]. The value is NaN where one is missing, and 0
    for boxes without area.
    """
    missing = np.isnan(true[:, :, None]).any(axis=-1) | np.isnan(predicted[:, None]).any(axis=-1)
    return np.where(missing, np.nan, box_iou(true, predicted))


def select_frames(rows: Floats, own_frames: Integers, frames: Integers) -> Floats:
    """Return rows (own frames, ...) at other frames (frames, ...), NaN in frames without a row."""
    selected = np.full((len(frames), *rows.shape[1:]), np.nan)
    _, own, places = np.intersect1d(own_frames, frames, assume_unique=True, return_indices=True)
    selected[places] = rows[own]
    return selected


def joint_distances(predicted: Floats, true: Floats) -> Floats:
    """Return the distance of every pair of people in every frame (frames, true, predicted) [m].

    The distance is the mean over common joints, infinite without common joints. People are
    (frames, persons, joints, 3) [m]; NaN where missing.
    """
    distances = np.empty((len(true), true.shape[1], predicted.shape[1]))
    # Frames per batch of distances: tens of megabytes for 25 people on either side.
    chunk_frames = 64
    for start in range(0, len(true), chunk_frames):
        part = slice(start, start + chunk_frames)
        offset = predicted[part, None] - true[part, :, None]
        each = np.sqrt(np.einsum("...i,...i->...", offset, offset))
        common = np.isfinite(each)
        count = common.sum(-1)
        total = np.where(common, each, 0.0).sum(-1)
        distances[part] = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return distances


def match_people(distances: Floats, gate: float) -> Integers:
    """Return the predicted person matched to each true one (frames, true), -1 for none.

    One-to-one per frame, with the least sum of distances (frames, true persons, predicted persons)
    [m], where an unmatched true person costs as much as a match at the gate (Hungarian method).
    Matching ignores ids.
    """
    match = np.full(distances.shape[:2], -1, dtype=np.int64)
    costs = np.minimum(distances, gate)
    for frame, cost in enumerate(costs):
        rows, columns = linear_sum_assignment(cost)
        good = distances[frame, rows, columns] <= gate
        match[frame, rows[good]] = columns[good]
    return match


def match_boxes(overlap: Floats, least: float) -> Integers:
    """Return the predicted person matched to each true one (frames, true), -1 for none.

    One-to-one and greedy per frame, by falling overlap (frames, true persons, predicted persons)
    [1], down to the least.
    """
    frames, true, predicted = overlap.shape
    match = np.full((frames, true), -1, dtype=np.int64)
    left = np.where(overlap >= least, overlap, -1.0)
    every = np.arange(frames)
    for _ in range(min(true, predicted)):
        row, column = np.divmod(left.reshape(frames, -1).argmax(-1), predicted)
        found = left[every, row, column] >= 0.0
        match[every[found], row[found]] = column[found]
        left[every, row, :] = -1.0
        left[every, :, column] = -1.0
    return match


def merge_tracks(pairs: Integers, cost: Floats) -> Integers:
    """Return the predicted person of each true one (frames, true), by whole tracks.

    A track belongs to the true person of its most frequent match, in all its frames: after an
    identity switch it is wrong, however near another person is. The function merges tracks of one
    true person; if several exist in one frame, it takes the one of least cost.

    `pairs` (frames, true persons) are matches per frame, -1 for none; `cost` (frames, true,
    predicted persons) is infinite where either does not exist.
    """
    _, true, predicted = cost.shape
    if not predicted:
        return pairs
    frame, person = np.nonzero(pairs >= 0)
    votes = np.zeros((true, predicted), dtype=np.int64)
    np.add.at(votes, (person, pairs[frame, person]), 1)
    owner = np.where(votes.any(axis=0), votes.argmax(axis=0), -1) if true else votes.sum(axis=0)
    owned = np.where(owner == np.arange(true)[:, None], cost, np.inf)
    cheapest = owned.argmin(axis=-1)
    known = np.isfinite(np.take_along_axis(owned, cheapest[..., None], axis=-1)[..., 0])
    return np.where(known, cheapest, -1)


def take_matched(people: Floats, match: Integers) -> Floats:
    """Return predicted people in the order of `match` (frames, true persons), NaN for -1, none."""
    if not people.shape[1]:
        return np.full((*match.shape, *people.shape[2:]), np.nan)
    chosen = np.take_along_axis(people, np.maximum(match, 0)[..., None, None], axis=1)
    return np.where((match >= 0)[..., None, None], chosen, np.nan)


def register_world(predicted: Floats, true: Floats, gate: float) -> Similarity | None:
    """Return the similarity that matches most predicted people to true ones, None if none match.

    Every pair of a predicted and a true person gives a candidate, from their whole paths. The
    candidate with the least sum of distances from true to predicted people, each clipped at the
    gate, wins; a fit to all its matches refines it.

    Both are (frames, persons, joints, 3) [m], NaN where missing; `gate` [m] is the maximum distance
    of matched people after the motion.
    """
    rounds = 3  # iterations of matching and alignment, enough to converge
    shared = np.flatnonzero(_any_joint(predicted) & _any_joint(true))
    if not len(shared):
        return None
    # Sample frames, evenly spread: enough to distinguish paths.
    max_frames = 48
    frames = shared[np.unique(np.linspace(0, len(shared) - 1, max_frames).round().astype(int))]
    predicted, true = predicted[frames], true[frames]
    rows, columns = _pairs(predicted, true)
    if not len(rows):
        return None
    joints = true.shape[0] * true.shape[2]
    motions = align(
        np.swapaxes(predicted, 0, 1).reshape(-1, joints, 3)[columns],
        np.swapaxes(true, 0, 1).reshape(-1, joints, 3)[rows],
        with_scale=True,
    )
    middles, targets = _middles(predicted), _middles(true)
    left = [
        _unmatched_distance(_one(motions, index).apply(middles), targets, gate)
        for index in range(len(rows))
    ]
    motion = _one(motions, int(np.argmin(left)))
    for _ in range(rounds):
        distances = joint_distances(move_people(motion, predicted), true)
        found = take_matched(predicted, match_people(distances, gate))
        if not np.isfinite(found).any():
            break
        motion = align(found.reshape(-1, 3), true.reshape(-1, 3), with_scale=True)
    return motion


def _any_joint(people: Floats) -> Flags:
    """Return the mask of frames with at least one person (frames,)."""
    return np.asarray(np.isfinite(people[..., 0]).any((-1, -2)))


def move_people(motion: Similarity, people: Floats) -> Floats:
    """Return people (frames, persons, joints, 3) [m] after a motion of the world."""
    return motion.apply(people.reshape(len(people), -1, 3)).reshape(people.shape)


def _pairs(predicted: Floats, true: Floats) -> tuple[Integers, Integers]:
    """Return true and predicted persons of the pairs with most common joints."""
    known_true = np.isfinite(np.swapaxes(true[..., 0], 0, 1)).reshape(true.shape[1], -1)
    known = np.isfinite(np.swapaxes(predicted[..., 0], 0, 1)).reshape(predicted.shape[1], -1)
    common = known_true.astype(np.int64) @ known.astype(np.int64).T
    # Maximum pairs of people to try, by falling number of common joints: all of 20 against 20.
    max_pairs = 400
    order = np.argsort(-common, axis=None, kind="stable")[:max_pairs]
    # A whole body's; where no pair has them, as many as any has, down to those of PA-MPJPE.
    fewest = min(true.shape[2], max(7, int(common.max(initial=0))))
    order = order[common.ravel()[order] >= fewest]
    rows, columns = np.divmod(order, predicted.shape[1])
    return rows, columns


def _middles(people: Floats) -> Floats:
    """Return the mean joint of every person (frames, persons, 3), NaN without joints."""
    known = np.isfinite(people).all(-1, keepdims=True)
    count = known.sum(-2)
    total = np.where(known, people, 0.0).sum(-2)
    middles = np.full(total.shape, np.nan)
    np.divide(total, count, out=middles, where=count > 0)
    return middles


def _unmatched_distance(predicted: Floats, true: Floats, gate: float) -> float:
    """Return the summed distance of true people to the nearest predicted one, clipped at gate."""
    distance = np.linalg.norm(predicted[:, None] - true[:, :, None], axis=-1)
    nearest = np.where(np.isnan(distance), gate, distance).min(axis=-1)
    return float(np.minimum(nearest, gate).sum())


def _one(motions: Similarity, index: int) -> Similarity:
    return Similarity(motions.scale[index], motions.rotation[index], motions.translation[index])


def match_tracks(
    people: Floats,
    true: Floats,
    distances: Floats,
    match: Integers,
    camera: Camera | None,
    boxes: Floats | None,
    settings: EvaluationSettings,
) -> Integers:
    """Return the predicted person of each true one (frames, true), by whole tracks.

    `people` and `true` are (frames, persons, 17, 3) [m], NaN where missing, `distances` (frames,
    true, predicted persons) [m], `match` (frames, true persons) the matches by these. With a
    camera, boxes in its image are compared: `boxes` (frames, predicted persons, 4) [px], or those
    of the joints. InputError if the camera has another number of frames.
    """
    if camera is not None:
        if camera.batch_shape not in ((), (1,), (len(true),)):
            raise InputError(
                "camera to match in",
                expected=f"one row, or {len(true)}: one for each frame of the reference",
                found=f"{camera.batch_shape}",
                todo="Name the camera of the clip that the reference belongs to.",
            )
        found = joint_boxes(people, camera) if boxes is None else boxes
        overlap = box_overlaps(found, joint_boxes(true, camera))
        cost = np.where(np.isnan(overlap), np.inf, 1.0 - overlap)
        return merge_tracks(match_boxes(overlap, settings.min_overlap), cost)
    possible = min(
        int(np.isfinite(side[..., 0]).any(-1).sum()) for side in (people, true[_any_joint(people)])
    )
    if (match >= 0).sum() < settings.min_matched_share * possible:
        motion = register_world(people, true, settings.match_gate_m)
        if motion is not None:
            distances = joint_distances(move_people(motion, people), true)
            match = match_people(distances, settings.match_gate_m)
    return merge_tracks(match, distances)
