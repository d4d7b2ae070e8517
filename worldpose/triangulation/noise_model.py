"""Detector noise by joint and by confidence, learned from residuals between views of a clip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compiled
from worldpose.triangulation.batched_gauss_newton import (
    EXTRA,
    LANES,
    LEVERAGE,
    PRECISION,
    ROWS,
    SCALE,
    SQUARED,
    STATE,
    USED,
    weigh,
)
from worldpose.triangulation.consensus import consensus
from worldpose.triangulation.observations import Rig, gather, linearize

BINS: Final = 8
"""Confidence classes with equally many observations."""
ROUNDS: Final = 4
"""Iterations; weights, inliers and variances settle after three."""
PRIOR: Final = 60.0
"""Degrees of freedom of the stated noise as a prior: few observations change little."""
LEAST: Final = 0.01
"""Smallest factor on a variance: perfect agreement of views does not imply certainty."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Factors on the stated variance of an observation.

    Attributes:
        joint: (joints,) factor on the variance of each joint.
        confidence: (knots,) ascending confidences.
        precision_at: (knots,) inverse of the factor on the variance there; linear between them.
    """

    joint: Floats
    confidence: Floats
    precision_at: Floats

    @classmethod
    def stated(cls, joints: int) -> NoiseModel:
        """Return the model of the settings: variance proportional to the inverse confidence."""
        return cls(np.ones(joints), np.array([0.0, 1.0]), np.array([0.0, 1.0]))

    @property
    def factor(self) -> float:
        """Median over joints of a confident keypoint's noise over the stated noise [1]."""
        return float(np.median(np.sqrt(self.joint / self.precision_at[-1])))

    def precision(self, confidence: NDArray[np.floating]) -> Floats:
        """Return the inverse of the factor (..., joints); 0 without an observation."""
        precision = np.empty(confidence.shape)
        rows = np.ascontiguousarray(confidence).reshape(-1, len(self.joint))
        out = precision.reshape(-1, len(self.joint))
        _precision(rows, 1.0 / self.joint, self.confidence, self.precision_at, out)
        return precision


def learn_noise(
    rig: Rig,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    index: NDArray[np.integer],
    shift: Floats,
    noise: tuple[float, float],
    limit: float,
) -> NoiseModel:
    """Return the noise model learned from the residuals of a sample of frames.

    A residual is smaller than the error that causes it, because the point follows its observations:
    sums of squares are divided by degrees of freedom, two per observation minus its leverage.
    """
    count, joints = index.shape[1], confidence.shape[-1]
    model = NoiseModel.stated(joints)
    place = np.maximum(index, 0).astype(np.int64)[..., None]
    certain = np.take_along_axis(np.asarray(confidence, np.float64), place, axis=2)
    certain = np.where(index[..., None] >= 0, certain, np.nan).transpose(0, 2, 3, 1)
    usable = (certain > 0.0) & np.isfinite(certain)
    if not usable.any():
        return model
    edges = np.quantile(certain[usable], np.linspace(0.0, 1.0, BINS + 1))
    logarithm = np.log(np.where(usable, certain, 1.0))
    bin_of = np.clip(np.searchsorted(edges, certain, side="right") - 1, 0, BINS - 1)
    sums = np.bincount(bin_of[usable], logarithm[usable], BINS)
    members = np.bincount(bin_of[usable], minlength=BINS).astype(np.float64)
    filled = members > 0
    knots = np.divide(sums[filled], members[filled])
    bin_of = (np.cumsum(filled) - 1)[bin_of]
    factor = np.exp(-knots)
    model = NoiseModel(np.ones(joints), np.exp(knots), 1.0 / factor)
    joint_of = np.broadcast_to(np.arange(joints)[:, None], certain.shape)
    shape = certain.shape
    squares, known, freedom = np.empty(shape), np.empty(shape), np.empty(shape)
    for _ in range(ROUNDS):
        precision = model.precision(confidence)
        _residuals(
            *(keypoints, precision, index, shift, rig.cameras, rig.depths, noise, limit),
            *(squares.reshape(-1, count), known.reshape(-1, count), freedom.reshape(-1, count)),
        )
        used = freedom > 0.0
        joint = model.joint
        by_bin, by_joint = bin_of[used], joint_of[used]
        excess = np.maximum(squares[used] - known[used] * freedom[used], 0.0)
        expected = (excess / factor[by_bin] / joint[by_joint], freedom[used])
        factor = np.maximum(factor * _ratio(by_bin, len(factor), *expected), LEAST)
        expected = (excess / factor[by_bin] / joint[by_joint], freedom[used])
        joint = joint * _ratio(by_joint, joints, *expected)
        # The factor must not rise with confidence: take the running minimum.
        factor = np.minimum.accumulate(factor)
        model = NoiseModel(joint, model.confidence, 1.0 / factor)
    return model


def _ratio(group: NDArray[np.int64], groups: int, squares: Floats, freedom: Floats) -> Floats:
    """Return variance over assumed variance, (groups,), shrunk towards the overall ratio."""
    overall = (squares.sum() + PRIOR) / (freedom.sum() + PRIOR)
    total = np.bincount(group, squares, groups) + PRIOR * overall
    ratio: Floats = total / (np.bincount(group, freedom, groups) + PRIOR)
    return ratio


@compiled
def _residuals(
    keypoints: NDArray[np.floating],
    precision: NDArray[np.floating],
    index: NDArray[np.integer],
    shift: Floats,
    cameras: Floats,
    depths: Floats,
    noise: tuple[float, float],
    limit: float,
    squares: Floats,
    known: Floats,
    freedom: Floats,
) -> None:
    """Write (points, cameras): squared errors, additional variance, degrees of freedom.

    The first two are in units of the stated variance; all are 0 where a view is not used.
    """
    tiles, state = np.empty((len(cameras), ROWS * LANES)), np.empty(STATE * LANES)
    total = len(squares)
    for first in range(0, total, LANES):
        gather(keypoints, precision, index, shift, first, cameras, tiles)
        for camera in range(len(cameras)):
            linearize(tiles[camera], cameras[camera])
        consensus(tiles, depths, noise, limit, state)
        for camera in range(len(cameras)):
            tile, depth = tiles[camera], depths[camera]
            weigh(tile, depth, noise, state)
            for j in range(min(LANES, total - first)):
                free = 2.0 - tile[LEVERAGE + j]
                if tile[USED + j] > 0.0 and free > 1e-6:
                    z = depth[0] * state[j] + depth[1] * state[LANES + j]
                    z += depth[2] * state[2 * LANES + j] + depth[3]
                    base = noise[0] ** 2 + tile[SCALE + j] / (z * z) * noise[1] ** 2
                    extra = tile[EXTRA + j] / base
                    squares[first + j, camera] = tile[SQUARED + j] * (
                        1.0 / tile[PRECISION + j] + extra
                    )
                    known[first + j, camera] = extra
                    freedom[first + j, camera] = free
                else:
                    squares[first + j, camera] = 0.0
                    known[first + j, camera] = 0.0
                    freedom[first + j, camera] = 0.0


@compiled
def _precision(
    confidence: NDArray[np.floating],
    weight: Floats,
    knots: Floats,
    values: Floats,
    out: Floats,
) -> None:
    """Write (rows, joints): the interpolated value, constant beyond the knots, times the weight."""
    last = len(knots) - 1
    for row in range(len(confidence)):
        for joint in range(len(weight)):
            given = float(confidence[row, joint])
            if not 0.0 < given < np.inf:
                out[row, joint] = 0.0
                continue
            k = 1
            while k < last and given > knots[k]:
                k += 1
            if last == 0:
                out[row, joint] = values[0] * weight[joint]
                continue
            width = knots[k] - knots[k - 1]
            share = (given - knots[k - 1]) / width if width > 0.0 else 1.0
            share = min(1.0, max(0.0, share))
            value = values[k - 1] + share * (values[k] - values[k - 1])
            out[row, joint] = value * weight[joint]
