"""Identity metrics of tracks: IDF1, switches, fragmentations, HOTA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

HOTA_LEVELS: Final = np.arange(1, 20) / 20.0
"""Similarity thresholds from 0.05 to 0.95 that HOTA averages over."""


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
    distances: NDArray[np.float64],
    true_exists: NDArray[np.bool_],
    predicted_exists: NDArray[np.bool_],
    gate: float,
) -> IdentityScores:
    """Return the identity scores of predicted tracks against true people.

    Args:
        distances: (frames, true persons, predicted persons) [m]; infinite where either is absent.
        true_exists: (frames, true persons).
        predicted_exists: (frames, predicted persons).
        gate: maximum distance of a match [m].

    Note:
        IDF1: Ristani et al., ECCV-W 2016. Switches and fragmentations: Bernardin and Stiefelhagen,
        2008, as counted by MOTChallenge. HOTA: Luiten et al., IJCV 2021.
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


def _interruptions(
    distances: NDArray[np.float64], true_exists: NDArray[np.bool_], gate: float
) -> tuple[int, int]:
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
    similarity: NDArray[np.float64],
    true_exists: NDArray[np.bool_],
    predicted_exists: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
