"""Matches of predicted to true people: per frame, and per track."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

_CHUNK: Final = 64
"""Frames per batch of distances: tens of megabytes for 25 people on either side."""


def joint_distances(
    predicted: NDArray[np.float64], true: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distance of every pair of people in every frame (frames, true, predicted) [m].

    The distance is the mean over common joints, infinite without common joints.

    Args:
        predicted: (frames, predicted persons, joints, 3) [m]; NaN where missing.
        true: (frames, true persons, joints, 3) [m]; NaN where missing.
    """
    distances = np.empty((len(true), true.shape[1], predicted.shape[1]))
    for start in range(0, len(true), _CHUNK):
        part = slice(start, start + _CHUNK)
        offset = predicted[part, None] - true[part, :, None]
        each = np.sqrt(np.einsum("...i,...i->...", offset, offset))
        common = np.isfinite(each)
        count = common.sum(-1)
        total = np.where(common, each, 0.0).sum(-1)
        distances[part] = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return distances


def match_people(distances: NDArray[np.float64], gate: float) -> NDArray[np.int64]:
    """Return the predicted person matched to each true one (frames, true), -1 for none.

    One-to-one per frame, with the least sum of distances, where an unmatched true person costs as
    much as a match at the gate (Hungarian method). Matching ignores ids.

    Args:
        distances: (frames, true persons, predicted persons) [m].
        gate: maximum distance of a match [m].
    """
    match = np.full(distances.shape[:2], -1, dtype=np.int64)
    costs = np.minimum(distances, gate)
    for frame, cost in enumerate(costs):
        rows, columns = linear_sum_assignment(cost)
        good = distances[frame, rows, columns] <= gate
        match[frame, rows[good]] = columns[good]
    return match


def match_boxes(overlap: NDArray[np.float64], least: float) -> NDArray[np.int64]:
    """Return the predicted person matched to each true one (frames, true), -1 for none.

    One-to-one and greedy per frame, by falling overlap (E3).

    Args:
        overlap: (frames, true persons, predicted persons) intersection over union [1].
        least: minimum overlap of a match [1].
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


def merge_tracks(pairs: NDArray[np.int64], cost: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the predicted person of each true one (frames, true), by whole tracks.

    A track belongs to the true person of its most frequent match, in all its frames: after an
    identity switch it is wrong, however near another person is. The function merges tracks of one
    true person; if several exist in one frame, it takes the one of least cost.

    Args:
        pairs: (frames, true persons) matches per frame, -1 for none.
        cost: (frames, true persons, predicted persons); infinite where either does not exist.

    Note:
        E3.
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


def taken(people: NDArray[np.float64], match: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return predicted people in the order of the true ones (frames, true, joints, 3).

    Args:
        people: (frames, predicted persons, joints, 3) [m].
        match: (frames, true persons) index of the predicted person, -1 for none, which gives NaN.
    """
    if not people.shape[1]:
        return np.full((*match.shape, *people.shape[2:]), np.nan)
    chosen = np.take_along_axis(people, np.maximum(match, 0)[..., None, None], axis=1)
    return np.where((match >= 0)[..., None, None], chosen, np.nan)
