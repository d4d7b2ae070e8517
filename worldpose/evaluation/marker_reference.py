"""Marker-based reference laid over a prediction in time and space (X1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import minimize_scalar

from data_contracts.records import Record
from worldpose.errors import DegenerateError
from worldpose.evaluation.alignment import Similarity, align
from worldpose.evaluation.matching import joint_distances, match_people, taken
from worldpose.evaluation.registration import register_world
from worldpose.formats import JointTracks

Floats = NDArray[np.float64]


class ReferenceSettings(Record):
    """How the reference is laid over the prediction."""

    max_offset: float = Field(default=2.0, gt=0)
    """Largest difference of the clocks that is looked for, either way [s]."""
    step: float = Field(default=0.2, gt=0)
    """Between differences that are tried at first [s]: a walk of 30 cm, within the gate."""
    match_gate: float = Field(default=1.0, gt=0)
    """Largest mean joint distance of a match, once laid over [m], as in the evaluation."""


@dataclass(frozen=True, eq=False)
class ReferenceAlignment:
    """How a reference lies over a prediction."""

    offset: float
    """Time on the reference's clock at match frame 0 [s]."""
    motion: Similarity
    """From the reference's world into the prediction's; scale 1."""
    residual: float
    """Root mean square distance of joints after it [m]."""


def lay_over(
    prediction: JointTracks,
    joints: Floats,
    rate: float,
    fps: float,
    settings: ReferenceSettings | None = None,
) -> tuple[JointTracks, ReferenceAlignment]:
    """Return the reference in the prediction's frames and world, and how it came there.

    The clocks' difference is the one that leaves the least distance: tried on a grid with people
    registered anew each time, then refined with people as they are matched. The motion is rigid:
    a wrong size of the prediction stays an error.

    Args:
        prediction: estimated joints.
        joints: (samples, persons, 17, 3) [m] in the reference's world; NaN where missing.
        rate: samples in a second [1/s].
        fps: match frames in a second [1/s].
        settings: the defaults if None.

    Raises:
        DegenerateError: nowhere do prediction and reference look alike.
    """
    settings = settings or ReferenceSettings()
    times = prediction.frames / fps
    count = int(np.ceil(settings.max_offset / settings.step))
    grid = np.arange(-count, count + 1) * settings.step
    tried = [
        (_left(prediction.joints, sampled(joints, rate, times + o), settings), o) for o in grid
    ]
    best, offset = min(tried, key=lambda pair: pair[0][0])
    _, match = best
    if match is None:
        raise DegenerateError(
            "the reference matches the prediction nowhere within "
            f"{settings.max_offset:g} s of difference between their clocks"
        )

    def error(shift: float) -> float:
        return _fitted(prediction.joints, sampled(joints, rate, times + shift), match)[1]

    # Tenths of a millisecond: a runner's millimetre.
    found = minimize_scalar(
        error,
        bounds=(offset - settings.step, offset + settings.step),
        method="bounded",
        options={"xatol": 1e-4},
    )
    moved = sampled(joints, rate, times + found.x)
    motion, residual = _fitted(prediction.joints, moved, match)
    placed = motion.apply(moved.reshape(-1, 3)).reshape(moved.shape)
    ids = np.arange(1, moved.shape[1] + 1)
    tracks = JointTracks(prediction.frames, ids, placed)
    return tracks, ReferenceAlignment(float(found.x), motion, residual)


def sampled(joints: Floats, rate: float, times: Floats) -> Floats:
    """Return joints (times, persons, 17, 3) at times on their own clock, straight between samples.

    NaN outside the samples, and where either neighbour is missing.

    Args:
        joints: (samples, persons, 17, 3) [m].
        rate: samples in a second [1/s].
        times: (times,) [s] since the first sample.
    """
    place = np.round(times * rate, 9)
    before = np.floor(place).astype(np.int64)
    share = (place - before)[:, None, None, None]
    last = len(joints) - 1
    inside = (place >= 0.0) & (place <= last)
    low, high = np.clip(before, 0, last), np.clip(before + 1, 0, last)
    # On a sample, the next one has no say, also where it is missing.
    between = (1.0 - share) * joints[low] + np.where(share > 0.0, share * joints[high], 0.0)
    return np.where(inside[:, None, None, None], between, np.nan)


def _left(
    people: Floats, reference: Floats, settings: ReferenceSettings
) -> tuple[float, NDArray[np.int64] | None]:
    """Mean distance of everybody there, cut at the gate, and who is whom after registration."""
    motion = register_world(reference, people, settings.match_gate)
    if motion is None:
        return np.inf, None
    moved = motion.apply(reference.reshape(len(reference), -1, 3)).reshape(reference.shape)
    distances = joint_distances(people, moved)
    match = match_people(distances, settings.match_gate)
    there = int(np.isfinite(reference[..., 0]).any(-1).sum())
    if not (match >= 0).any():
        return np.inf, None
    chosen = np.take_along_axis(distances, np.maximum(match, 0)[..., None], axis=2)[..., 0]
    total = np.where(match >= 0, chosen, 0.0).sum() + settings.match_gate * (
        there - (match >= 0).sum()
    )
    # A long overlap counts more than a short one that happens to fit.
    missing = settings.match_gate * (len(reference) * reference.shape[1] - there)
    return float(total + missing), match


def _fitted(
    people: Floats, reference: Floats, match: NDArray[np.int64]
) -> tuple[Similarity, float]:
    """The rigid motion of the reference onto matched people, and the distance left [m]."""
    target = taken(people, match).reshape(-1, 3)
    motion = align(reference.reshape(-1, 3), target, with_scale=False)
    squares = np.square(motion.apply(reference.reshape(-1, 3)) - target).sum(-1)
    known = np.isfinite(squares)
    return motion, float(np.sqrt(squares[known].mean())) if known.any() else np.inf
