"""Alignment of a marker-based reference to a prediction in time and space (X1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import minimize_scalar

from data_contracts.arrays import Floats
from data_contracts.records import Record
from worldpose.errors import DegenerateError
from worldpose.evaluation.alignment import Similarity, align
from worldpose.evaluation.matching import joint_distances, match_people, taken
from worldpose.evaluation.registration import register_world
from worldpose.formats import JointTracks


class ReferenceSettings(Record):
    """Search range and gate of the alignment."""

    max_offset: float = Field(default=2.0, gt=0)
    """Maximum clock offset of the search, either way [s]."""
    step: float = Field(default=0.2, gt=0)
    """Step of the initial grid over clock offsets [s]: a walk of 30 cm, within the gate."""
    match_gate: float = Field(default=1.0, gt=0)
    """Maximum mean joint distance of a match after alignment [m], as in the evaluation."""


@dataclass(frozen=True, eq=False)
class ReferenceAlignment:
    """Clock offset and motion that align a reference to a prediction."""

    offset: float
    """Time on the reference's clock at match frame 0 [s]."""
    motion: Similarity
    """From the reference's world into the prediction's; scale 1."""
    residual: float
    """Root mean square distance of joints after the motion [m]."""


def lay_over(
    prediction: JointTracks,
    joints: Floats,
    rate: float,
    fps: float,
    settings: ReferenceSettings | None = None,
) -> tuple[JointTracks, ReferenceAlignment]:
    """Return the reference in the prediction's frames and world, and its alignment.

    The clock offset minimizes the distance: a grid search with a new registration of people at each
    offset, then a refinement with fixed matches. The motion is rigid: a wrong size of the
    prediction remains an error.

    Args:
        prediction: estimated joints.
        joints: (samples, persons, 17, 3) [m] in the reference's world; NaN where missing.
        rate: samples per second [1/s].
        fps: match frames per second [1/s].
        settings: the defaults if None.

    Raises:
        DegenerateError: prediction and reference match at no offset.
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

    # Tenths of a millisecond: a millimetre of a runner's path.
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
    """Return joints (times, persons, 17, 3) at times on their own clock, interpolated linearly.

    NaN outside the samples, and if either neighbour is missing.

    Args:
        joints: (samples, persons, 17, 3) [m].
        rate: samples per second [1/s].
        times: (times,) [s] since the first sample.
    """
    place = np.round(times * rate, 9)
    before = np.floor(place).astype(np.int64)
    share = (place - before)[:, None, None, None]
    last = len(joints) - 1
    inside = (place >= 0.0) & (place <= last)
    low, high = np.clip(before, 0, last), np.clip(before + 1, 0, last)
    # Exactly on a sample, ignore the next one, which may be missing.
    between = (1.0 - share) * joints[low] + np.where(share > 0.0, share * joints[high], 0.0)
    return np.where(inside[:, None, None, None], between, np.nan)


def _left(
    people: Floats, reference: Floats, settings: ReferenceSettings
) -> tuple[float, NDArray[np.int64] | None]:
    """Return the sum of joint distances, clipped at the gate, and the match after registration."""
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
    # Missing people cost the gate, so that a short overlap that fits by chance does not win.
    missing = settings.match_gate * (len(reference) * reference.shape[1] - there)
    return float(total + missing), match


def _fitted(
    people: Floats, reference: Floats, match: NDArray[np.int64]
) -> tuple[Similarity, float]:
    """Return the rigid motion of the reference onto matched people, and the rms residual [m]."""
    target = taken(people, match).reshape(-1, 3)
    motion = align(reference.reshape(-1, 3), target, with_scale=False)
    squares = np.square(motion.apply(reference.reshape(-1, 3)) - target).sum(-1)
    known = np.isfinite(squares)
    return motion, float(np.sqrt(squares[known].mean())) if known.any() else np.inf
