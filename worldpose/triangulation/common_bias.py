"""Bias of detected joints that all views share, estimated from body proportions (T3).

No residual shows that bias. But it makes bones of all persons longer or shorter for the whole clip,
while human proportions are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17

BY_JOINT: Final = np.array(
    [
        next(
            (
                factor
                for part, factor in (("elbow", 1.1), ("wrist", 1.1), ("hip", 1.35))
                if part in name
            ),
            0.9 if "knee" in name or "ankle" in name else 1.0,
        )
        for name in COCO17
    ]
)
"""Common bias of each joint relative to the average one (17,) [1].

Errors against the labels of real people (Shelf, frames 300 to 510, five cameras), root mean square
per axis: shoulders 27 mm, elbows 30, wrists 31, hips 43, knees 23, ankles 23. Against markers hips
and knees are 30 to 50 mm off, ankles 1 to 15 (Needham et al., Scientific Reports 11, 2021). No such
measurement of the face is available."""


@dataclass(frozen=True)
class Proportion:
    """Body length that hardly depends on the pose.

    Attributes:
        ends: one or two pairs of ends; an end is the mean of its joints.
        share: of stature [1].
        spread: relative standard deviation of published values of the share [1].
        offsets: variance of the length for joint biases of variance 1 per axis, mirrored left to
            right [1].
    """

    ends: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    share: float
    spread: float
    offsets: float


def _limb(upper: str, lower: str, share: float) -> Proportion:
    sides = ("left", "right")
    pairs = [tuple(COCO17.index(f"{side}_{name}") for name in (upper, lower)) for side in sides]
    offsets = float((BY_JOINT[list(pairs[0])] ** 2).sum())
    return Proportion(tuple(((a,), (b,)) for a, b in pairs), share, 0.03, offsets)


def _breadth(name: str, share: float, spread: float) -> Proportion:
    left, right = COCO17.index(f"left_{name}"), COCO17.index(f"right_{name}")
    # Both ends move outward together.
    return Proportion((((left,), (right,)),), share, spread, 4.0 * float(BY_JOINT[left]) ** 2)


PROPORTIONS: Final = (
    _limb("shoulder", "elbow", 0.162),
    _limb("elbow", "wrist", 0.154),
    _limb("hip", "knee", 0.2425),
    _limb("knee", "ankle", 0.249),
    _breadth("shoulder", 0.205, 0.07),
    _breadth("hip", 0.098, 0.08),
    Proportion((((5, 6), (11, 12)),), 0.294, 0.05, float((BY_JOINT[[5, 11]] ** 2).sum())),
)
"""Limbs and trunk between joint centres of men after P. de Leva, Journal of Biomechanics 29, 1996;
published breadths between the centres of shoulders and hips agree less."""
STATURE: Final = (1.72, 0.12)
"""Stature of people, mean and standard deviation per clip [m]: men, women or children."""
PERSONAL: Final = 0.035
"""Standard deviation of a person's proportion relative to the mean [1] (Drillis, Contini 1966)."""
PRIOR_DEGREES_OF_FREEDOM: Final = 8.0
"""Degrees of freedom of the inverse chi-square prior of the bias variance [1]. Proportions that fit
by chance barely lower the estimate, proportions that do not fit raise it."""
MIN_FRAMES: Final = 5
"""Frames needed to estimate the length of a person's bone."""


def learn_common_bias(joints: Floats, covariance: Floats, usual: float) -> float:
    """Return the estimated common bias per axis of an average joint [m].

    Lengths are medians over people of medians over frames, minus the contribution of noise. The
    bias is normal; the result is the root of the posterior mean of its variance.

    Args:
        joints: (frames, persons, 17, 3) [m].
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints` without common bias.
        usual: expected bias of detectors per axis [m].
    """
    if usual <= 0.0:
        return 0.0
    measured = [_length(joints, covariance, each) for each in PROPORTIONS]
    known = [index for index, (length, _, _) in enumerate(measured) if length > 0.0]
    factors = np.geomspace(0.2, 5.0, 121)
    posterior = -PRIOR_DEGREES_OF_FREEDOM * (np.log(factors) + 0.5 / factors**2)
    if known:
        length, variance, people = np.array([measured[index] for index in known]).T
        some = [PROPORTIONS[index] for index in known]
        share = np.array([each.share for each in some])
        spread = np.array([each.spread for each in some])
        own = (share * STATURE[0]) ** 2 * (spread**2 + PERSONAL**2 / people) + variance
        tall = STATURE[1] ** 2 * np.outer(share, share)
        offsets = usual**2 * np.array([each.offsets for each in some])
        off = length - share * STATURE[0]
        for index, factor in enumerate(factors):
            total = tall + np.diag(own + factor**2 * offsets)
            posterior[index] -= 0.5 * (
                off @ np.linalg.solve(total, off) + np.linalg.slogdet(total)[1]
            )
    weight = np.exp(posterior - posterior.max())
    return usual * float(np.sqrt((weight * factors**2).sum() / weight.sum()))


def _length(joints: Floats, covariance: Floats, what: Proportion) -> tuple[float, float, int]:
    """Return a length [m], its noise variance [m^2] and the number of people; zeros without any."""
    squares, traces = [], []
    for ends in what.ends:
        first, second = (joints[:, :, list(end)].mean(axis=2) for end in ends)
        trace = np.zeros(first.shape[:2])
        for end in ends:
            noise = np.einsum("...ii", covariance[:, :, list(end)])
            trace = trace + noise.sum(axis=-1) / len(end) ** 2
        squares.append(((first - second) ** 2).sum(axis=-1) - trace)
        traces.append(trace)
    square, trace = np.concatenate(squares), np.concatenate(traces)
    lengths, noises = [], []
    for person in range(square.shape[1]):
        there = np.isfinite(square[:, person])
        middle = float(np.median(square[there, person])) if there.sum() >= MIN_FRAMES else 0.0
        if middle > 0.0:
            lengths.append(np.sqrt(middle))
            # Detector errors persist over many frames, so all frames count as one observation.
            noises.append(float(np.median(trace[there, person])) / 3.0)
    if not lengths:
        return 0.0, 0.0, 0
    return float(np.median(lengths)), float(np.mean(noises)) / len(lengths), len(lengths)
