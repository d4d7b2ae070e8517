"""Registration of a prediction in its own world to the true world."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.evaluation.alignment import Similarity, align
from worldpose.evaluation.matching import joint_distances, match_people, taken

_FRAMES: Final = 48
"""Sample frames, evenly spread: enough to distinguish paths."""
_PAIRS: Final = 400
"""Maximum pairs of people to try, by falling number of common joints: all of 20 against 20."""
_ROUNDS: Final = 3
"""Iterations of matching and alignment, enough to converge."""


def register_world(
    predicted: NDArray[np.float64], true: NDArray[np.float64], gate: float
) -> Similarity | None:
    """Return the similarity that matches most predicted people to true ones, None without a match.

    Every pair of a predicted and a true person gives a candidate, from their whole paths. The
    candidate with the least sum of distances from true to predicted people, each clipped at the
    gate, wins; a fit to all its matches refines it.

    Args:
        predicted: (frames, predicted persons, joints, 3) [m]; NaN where missing.
        true: (frames, true persons, joints, 3) [m]; NaN where missing.
        gate: maximum distance of a match, after the motion [m].
    """
    shared = np.flatnonzero(_any_joint(predicted) & _any_joint(true))
    if not len(shared):
        return None
    frames = shared[np.unique(np.linspace(0, len(shared) - 1, _FRAMES).round().astype(int))]
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
        _left_over(_one(motions, index).apply(middles), targets, gate) for index in range(len(rows))
    ]
    motion = _one(motions, int(np.argmin(left)))
    for _ in range(_ROUNDS):
        distances = joint_distances(motion.apply(_flat(predicted)).reshape(predicted.shape), true)
        found = taken(predicted, match_people(distances, gate))
        if not np.isfinite(found).any():
            break
        motion = align(found.reshape(-1, 3), true.reshape(-1, 3), with_scale=True)
    return motion


def _any_joint(people: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the mask of frames with at least one person (frames,)."""
    return np.asarray(np.isfinite(people[..., 0]).any((-1, -2)))


def _flat(people: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return people reshaped to (frames, persons * joints, 3)."""
    return people.reshape(len(people), -1, 3)


def _pairs(
    predicted: NDArray[np.float64], true: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return true and predicted persons of the pairs with most common joints."""
    known_true = np.isfinite(np.swapaxes(true[..., 0], 0, 1)).reshape(true.shape[1], -1)
    known = np.isfinite(np.swapaxes(predicted[..., 0], 0, 1)).reshape(predicted.shape[1], -1)
    common = known_true.astype(np.int64) @ known.astype(np.int64).T
    order = np.argsort(-common, axis=None, kind="stable")[:_PAIRS]
    order = order[common.ravel()[order] >= true.shape[2]]
    rows, columns = np.divmod(order, predicted.shape[1])
    return rows, columns


def _middles(people: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean joint of every person (frames, persons, 3), NaN without joints."""
    known = np.isfinite(people).all(-1, keepdims=True)
    count = known.sum(-2)
    total = np.where(known, people, 0.0).sum(-2)
    middles = np.full(total.shape, np.nan)
    np.divide(total, count, out=middles, where=count > 0)
    return middles


def _left_over(predicted: NDArray[np.float64], true: NDArray[np.float64], gate: float) -> float:
    """Return the summed distance of true people to the nearest predicted one, clipped at gate."""
    distance = np.linalg.norm(predicted[:, None] - true[:, :, None], axis=-1)
    nearest = np.where(np.isnan(distance), gate, distance).min(axis=-1)
    return float(np.minimum(nearest, gate).sum())


def _one(motions: Similarity, index: int) -> Similarity:
    return Similarity(motions.scale[index], motions.rotation[index], motions.translation[index])
