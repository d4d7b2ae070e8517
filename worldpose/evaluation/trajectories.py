"""Trajectory errors with the paper's alignments and without alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.evaluation.alignment import align
from worldpose.evaluation.selected_joints import challenge_joints, mid_hip, paper_joints


@dataclass(frozen=True, eq=False)
class AlignedErrors:
    """Joint distances after alignment; NaN where a joint is missing on either side.

    Distances are (frames, persons, 14) [m], on the joints of E4.
    """

    shared: NDArray[np.float64]
    """One alignment for all people's whole trajectories (E1)."""
    per_person: NDArray[np.float64]
    """One alignment for each person's whole trajectory (E2)."""
    per_frame: NDArray[np.float64]
    """One alignment for each person in each frame (E1)."""
    scale: float
    """Scale of the shared alignment: true over predicted size; 1 if rigid, NaN without common
    joints."""


def aligned_errors(
    predicted: NDArray[np.float64],
    true: NDArray[np.float64],
    *,
    with_scale: bool,
    min_joints: int,
) -> AlignedErrors:
    """Return joint errors after the three alignments of the paper.

    Args:
        predicted: (frames, persons, 17, 3) [m], in the order of the true people; NaN = missing.
        true: (frames, persons, 17, 3) [m]; NaN where missing or not counted.
        with_scale: similarities if true, rigid motions if not.
        min_joints: minimum common joints of a person for the alignment per frame.
    """
    source, target = paper_joints(predicted), paper_joints(true)
    frames, persons, joints, _ = target.shape
    common = np.isfinite(source[..., 0]) & np.isfinite(target[..., 0])
    source = np.where(common[..., None], source, np.nan)

    everything = (frames * persons * joints, 3)
    shared = align(source.reshape(everything), target.reshape(everything), with_scale=with_scale)
    own_source, own_target = (
        np.swapaxes(points, 0, 1).reshape(persons, frames * joints, 3)
        for points in (source, target)
    )
    own = align(own_source, own_target, with_scale=with_scale)
    per_person = np.linalg.norm(own.apply(own_source) - own_target, axis=-1)
    enough = common.sum(-1) >= min_joints
    body = np.where(enough[..., None, None], source, np.nan)
    per_frame = align(body, target, with_scale=with_scale).apply(body) - target
    return AlignedErrors(
        shared=np.linalg.norm(
            shared.apply(source.reshape(everything)).reshape(target.shape) - target, axis=-1
        ),
        per_person=np.swapaxes(per_person.reshape(persons, frames, joints), 0, 1),
        per_frame=np.linalg.norm(per_frame, axis=-1),
        scale=float(shared.scale),
    )


def path_lengths(true: NDArray[np.float64], compared: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the length of every true person's path (persons,) [m].

    The path of the mid-hip through the compared frames, with straight lines across gaps.

    Args:
        true: (frames, persons, 17, 3) [m]; NaN where missing.
        compared: (frames, persons) whether both sides have the person.
    """
    hips = mid_hip(true)
    used = compared & np.isfinite(hips[..., 0])
    lengths = np.zeros(true.shape[1])
    for person in range(true.shape[1]):
        steps = np.diff(hips[used[:, person], person], axis=0)
        lengths[person] = np.linalg.norm(steps, axis=-1).sum()
    return lengths


def drift_per_meter(
    errors: NDArray[np.float64], lengths: NDArray[np.float64], min_length: float
) -> float | None:
    """Return the mean over people of mean error over path length [1], None without long paths.

    Args:
        errors: (frames, persons, joints) [m]; NaN where missing.
        lengths: (persons,) path lengths [m].
        min_length: minimum path length of a person [m].

    Note:
        E1. The ratio of the published columns does not give the published drift, so that the drift
        is no ratio of means over all people; this function averages the ratio of each trajectory.
    """
    known = np.isfinite(errors)
    count = known.sum((0, 2))
    far = (lengths >= min_length) & (count > 0)
    if not far.any():
        return None
    total = np.where(known, errors, 0.0).sum((0, 2))
    return float((total[far] / count[far] / lengths[far]).mean())


def challenge_errors(
    predicted: NDArray[np.float64], true: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return global and local joint errors (frames, persons, 13) [m], without any alignment.

    Local errors are relative to the mid-hip of each side.

    Args:
        predicted: (frames, persons, 17, 3) [m], in the order of the true people; NaN = missing.
        true: (frames, persons, 17, 3) [m]; NaN where missing.
    """
    offset = challenge_joints(predicted) - challenge_joints(true)
    roots = (mid_hip(predicted) - mid_hip(true))[..., None, :]
    return np.linalg.norm(offset, axis=-1), np.linalg.norm(offset - roots, axis=-1)


def acceleration_errors(
    predicted: NDArray[np.float64],
    true: NDArray[np.float64],
    frames: NDArray[np.int64],
    fps: float,
) -> NDArray[np.float64]:
    """Return errors of joint acceleration (frames - 2, persons, 14) [m/s^2], NaN where unknown.

    Second differences of three successive frames at the minimum step, on the joints of E4.

    Args:
        predicted: (frames, persons, 17, 3) [m], in the order of the true people; NaN = missing.
        true: (frames, persons, 17, 3) [m]; NaN where missing.
        frames: (frames,) match frames, rising.
        fps: match frames per second [1/s].
    """
    offset = paper_joints(predicted) - paper_joints(true)
    steps = np.diff(frames)
    if len(steps) < 2:
        return np.empty((0, *offset.shape[1:-1]))
    step = steps.min()
    regular = (steps[1:] == step) & (steps[:-1] == step)
    errors = np.linalg.norm(np.diff(offset, n=2, axis=0), axis=-1) * (fps / step) ** 2
    return np.where(regular[:, None, None], errors, np.nan)
