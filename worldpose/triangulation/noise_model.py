"""Errors of a detector: noise by joint and by confidence, and the bias that all views share.

The noise is learned from residuals between a clip's views. No residual shows the common bias,
but it makes bones of all persons longer or shorter for the whole clip, while human proportions are
known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel
from worldpose.triangulation.residuals import (
    LANES,
    Buffers,
    Observations,
    Rig,
    read_tile,
    write_leverages,
)
from worldpose.triangulation.solve import find_consensus

KINDS: Final = np.unique([name.split("_")[-1] for name in COCO17], return_inverse=True)[1]
"""Kind of each joint (17,): both sides are one kind."""
REACH: Final = (0.5, 1.0, 1.7)
"""Distances from the middle of the trunk between classes of limb positions [trunk lengths]."""
CONDITIONS: Final = 2 * (len(REACH) + 1)
"""Classes of a keypoint: limb positions, then the same behind a nearer person."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of keypoints, learned from how the views of a recording disagree.

    The variance of a keypoint per image axis [px^2], with scale s of the image there [px/m], is

        (pixel_noise_px^2 + (joint_noise_m s)^2) joint[j] camera[c, kind of j] condition[o] / g(q)

    for joint j, camera c, confidence q, and the condition o of limb and occlusion (`conditions`).

    Attributes:
        joint: (joints,) factor on the variance of each joint.
        confidence: (knots,) ascending confidences.
        precision_at: (knots,) g, inverse of the factor on the variance there; linear between them.
        camera: (cameras, joints) factor by camera and kind of joint.
        condition: (CONDITIONS,) factor by limb position and occlusion.
    """

    joint: Floats
    confidence: Floats
    precision_at: Floats
    camera: Floats
    condition: Floats

    @classmethod
    def nominal(cls, joints: int, cameras: int = 1) -> NoiseModel:
        """Return the model of the settings: variance proportional to the inverse confidence."""
        knots = np.array([0.0, 1.0])
        alike = np.ones((cameras, joints)), np.ones(CONDITIONS)
        return cls(np.ones(joints), knots, knots, *alike)

    @property
    def factor(self) -> float:
        """Median over joints of a confident keypoint's noise over the stated noise [1]."""
        return float(np.median(np.sqrt(self.joint / self.precision_at[-1])))

    def precision(
        self, confidence: NDArray[np.floating], condition: NDArray[np.uint8] | None = None
    ) -> Floats:
        """Return the inverse of the factor (frames, cameras, detections, joints); 0 where missing.

        The condition of each keypoint is that of `conditions`; None = not known.
        """
        precision = np.empty(confidence.shape)
        rows = np.ascontiguousarray(confidence).reshape(-1, len(self.joint))
        out = precision.reshape(-1, len(self.joint))
        factor, known, people = self.joint[None, None], np.zeros_like(rows, np.uint8), 1
        if condition is not None:
            factor = self.joint * self.camera[:, None] * self.condition[:, None]
            known, people = condition.reshape(rows.shape), confidence.shape[-2]
        _precision(rows, known, people, 1.0 / factor, self.confidence, self.precision_at, out)
        return precision


def conditions(keypoints: AnyFloats) -> NDArray[np.uint8]:
    """Return the condition of each keypoint (frames, cameras, detections, joints), see `REACH`.

    Occluded is a keypoint within the box of a person whose lowest keypoint is lower in the image:
    that person stands nearer to the camera. Points besides COCO-17 have the first condition.
    """
    found: NDArray[np.uint8] = np.zeros(keypoints.shape[:-1], np.uint8)
    people, joints = found.shape[-2:]
    if joints == len(COCO17):
        images = math.prod(found.shape[:-2])  # -1 is no number of images without people
        shown = keypoints.reshape(images, people, joints, 2)
        _find_conditions(shown, np.array(REACH), found.reshape(images, people, joints))
    return found


@compile_kernel
def _find_conditions(keypoints: AnyFloats, edges: Floats, found: NDArray[np.uint8]) -> None:
    """Write the conditions (images, people, 17) of keypoints (images, people, 17, 2) [px]."""
    people, joints = found.shape[1:]
    box = np.empty((people, 4))
    limits = np.empty(len(edges))
    for image in range(len(found)):
        for n in range(people):
            left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
            for j in range(joints):
                x, y = keypoints[image, n, j, 0], keypoints[image, n, j, 1]
                # Comparisons with NaN are false.
                left, right = (x if x < left else left), (x if x > right else right)
                top, bottom = (y if y < top else top), (y if y > bottom else bottom)
            box[n, 0], box[n, 1], box[n, 2], box[n, 3] = left, top, right, bottom
        for n in range(people):
            if not box[n, 0] <= box[n, 2]:
                continue
            at = keypoints[image, n]
            up_x = 0.5 * (at[5, 0] + at[6, 0] - at[11, 0] - at[12, 0])
            up_y = 0.5 * (at[5, 1] + at[6, 1] - at[11, 1] - at[12, 1])
            x0 = 0.25 * (at[5, 0] + at[6, 0] + at[11, 0] + at[12, 0])
            y0 = 0.25 * (at[5, 1] + at[6, 1] + at[11, 1] + at[12, 1])
            length = up_x**2 + up_y**2
            for e in range(len(edges)):
                limits[e] = edges[e] * edges[e] * length
            for j in range(joints):
                away = (at[j, 0] - x0) ** 2 + (at[j, 1] - y0) ** 2
                count = 0
                for e in range(len(edges)):
                    count += away > limits[e]
                found[image, n, j] = count
            for other in range(people):
                if not box[n, 3] < box[other, 3] or box[n, 2] <= box[other, 0]:
                    continue
                if box[other, 2] <= box[n, 0] or box[n, 3] <= box[other, 1]:
                    continue
                for j in range(joints):
                    x, y = at[j, 0], at[j, 1]
                    inside = box[other, 0] < x < box[other, 2] and box[other, 1] < y
                    if inside and y < box[other, 3] and found[image, n, j] <= len(edges):
                        found[image, n, j] += len(edges) + 1


def learn_noise(
    rig: Rig,
    detections: KeypointDetections,
    shift: Floats,
    noise: tuple[float, float],
    limit: float,
) -> NoiseModel:
    """Return the noise model learned from the residuals of a sample of frames.

    A residual is smaller than the error that causes it, because the point follows its observations:
    sums of squares are divided by degrees of freedom, two per observation minus its leverage. Each
    factor in turn is multiplied by the ratio of what its class shows to what the model expects,
    which maximizes the likelihood (iterative proportional fitting).

    Args:
        rig: the cameras.
        detections: detections in the sample.
        shift: shift of the observations, as in `Observations`.
        noise: stated noise, [px] and [m].
        limit: largest squared error of an inlier [variances].
    """
    confidence, index = detections.confidence, detections.detection_index
    count, joints = index.shape[1], confidence.shape[-1]
    model = NoiseModel.nominal(joints, count)

    def by_view(values: NDArray[Any]) -> NDArray[Any]:
        """Return values of detections as those of people (frames, persons, joints, cameras)."""
        place = np.maximum(index, 0).astype(np.int64)[..., None]
        return np.take_along_axis(values, place, axis=2).transpose(0, 2, 3, 1)

    there = (index >= 0).swapaxes(1, 2)[:, :, None]
    certain = np.where(there, by_view(np.asarray(confidence, np.float64)), np.nan)
    usable = (certain > 0.0) & np.isfinite(certain)
    if not usable.any():
        return model
    bins = 8  # Confidence classes with equally many observations.
    edges = np.quantile(certain[usable], np.linspace(0.0, 1.0, bins + 1))
    logarithm = np.log(np.where(usable, certain, 1.0))
    bin_of = np.clip(np.searchsorted(edges, certain, side="right") - 1, 0, bins - 1)
    sums = np.bincount(bin_of[usable], logarithm[usable], bins)
    members = np.bincount(bin_of[usable], minlength=bins).astype(np.float64)
    filled = members > 0
    knots = np.divide(sums[filled], members[filled])
    kinds = KINDS if joints == len(KINDS) else np.arange(joints)
    alike = int(kinds.max(initial=0)) + 1
    condition = conditions(detections.keypoints)
    classes = [
        np.broadcast_to(each, certain.shape)
        for each in (
            (np.cumsum(filled) - 1)[bin_of],
            np.arange(joints)[:, None],
            kinds[:, None] + alike * np.arange(count),
            by_view(condition),
        )
    ]
    tables = [np.exp(-knots), np.ones(joints), np.ones(alike * count), np.ones(CONDITIONS)]
    squares, known, freedom = (np.empty(certain.shape) for _ in range(3))
    # Weights, inliers and variances settle after three iterations.
    for _ in range(4):
        precision = model.precision(confidence, condition)
        _residuals(
            Observations.of(rig, detections.keypoints, precision, index, shift),
            noise,
            limit,
            Buffers.of(count),
            squares.reshape(-1, count),
            known.reshape(-1, count),
            freedom.reshape(-1, count),
        )
        used = freedom > 0.0
        free, chosen = freedom[used], [each[used] for each in classes]
        excess = np.maximum(squares[used] - known[used] * free, 0.0)
        for number, group in enumerate(chosen):
            expected = math.prod(table[each] for table, each in zip(tables, chosen, strict=True))
            # Prior degrees of freedom with ratio 1: few observations change little. A person's
            # error in one camera lasts, so that many frames count as few.
            prior = 60.0 if number < 2 else 20.0 * len(index)
            ratio = _variance_ratio(group, len(tables[number]), excess / expected, free, prior)
            # Perfect agreement of views does not imply certainty.
            tables[number] = np.maximum(tables[number] * ratio, 0.01 if number == 0 else 0.05)
            if number == 0:  # the factor must not rise with confidence
                tables[0] = np.minimum.accumulate(tables[0])
        camera = tables[2].reshape(count, alike)[:, kinds]
        model = NoiseModel(tables[1], np.exp(knots), 1.0 / tables[0], camera, tables[3])
    return model


def _variance_ratio(
    group: NDArray[np.int64], groups: int, squares: Floats, freedom: Floats, prior: float
) -> Floats:
    """Return variance over assumed variance, (groups,), shrunk towards the overall ratio."""
    overall = (squares.sum() + prior) / (freedom.sum() + prior)
    total = np.bincount(group, squares, groups) + prior * overall
    ratio: Floats = total / (np.bincount(group, freedom, groups) + prior)
    return ratio


@compile_kernel
def _residuals(
    observations: Observations,
    noise: tuple[float, float],
    limit: float,
    buffers: Buffers,
    squares: Floats,
    known: Floats,
    freedom: Floats,
) -> None:
    """Write (points, cameras): squared errors, additional variance, degrees of freedom.

    The first two are in units of the stated variance; all are 0 where a view is not used.
    """
    rig, tiles, state = observations.rig, buffers.tiles, buffers.state[0]
    point, total = state["point"], len(squares)
    for first in range(0, total, LANES):
        read_tile(observations, first, tiles)
        find_consensus(rig, noise, limit, buffers)
        for camera in range(len(tiles)):
            tile, depth = tiles[camera], rig.depths[camera]
            write_leverages(tile, depth, noise, state)
            for j in range(min(LANES, total - first)):
                free = 2.0 - tile["leverage"][j]
                if tile["used"][j] > 0.0 and free > 1e-6:
                    z = depth[0] * point[0, j] + depth[1] * point[1, j]
                    z += depth[2] * point[2, j] + depth[3]
                    base = noise[0] ** 2 + tile["scale"][j] / (z * z) * noise[1] ** 2
                    extra = tile["extra"][j] / base
                    squares[first + j, camera] = tile["squared"][j] * (
                        1.0 / tile["precision"][j] + extra
                    )
                    known[first + j, camera] = extra
                    freedom[first + j, camera] = free
                else:
                    squares[first + j, camera] = 0.0
                    known[first + j, camera] = 0.0
                    freedom[first + j, camera] = 0.0


@compile_kernel
def _precision(
    confidence: NDArray[np.floating],
    condition: NDArray[np.uint8],
    people: int,
    weight: Floats,
    knots: Floats,
    values: Floats,
    out: Floats,
) -> None:
    """Write (rows, joints): the interpolated value, constant beyond the knots, times the weight.

    Weights are (cameras, conditions, joints); `people` rows of a camera follow one another.
    """
    last = len(knots) - 1
    for row in range(len(confidence)):
        camera = row // people % len(weight)
        for joint in range(weight.shape[2]):
            # Without branches, which processors predict badly here.
            given = float(confidence[row, joint])
            k = 1
            for knot in range(1, last):
                k += given > knots[knot]
            width = knots[k] - knots[k - 1] if last else 0.0
            share = (given - knots[k - 1]) / width if width > 0.0 else 1.0
            share = min(1.0, max(0.0, share))
            value = values[k - 1] + share * (values[min(k, last)] - values[k - 1])
            there = (given > 0.0) & (given < np.inf)
            out[row, joint] = value * weight[camera, condition[row, joint], joint] if there else 0.0


OCCLUDED: Final = 2.0
"""Growth of the error that all views share with the share of a person's views that miss the joint
[1]: what occludes a joint in some views misleads the others. Without a constant offset, joints of
real people (Shelf, frames 300 to 420) are 20 mm per axis from labels where all views agree, 25 mm
without one of them, 37 mm without two, and the residuals are the same."""


def shared_variance(bias: Floats, views: NDArray[np.integer], seen: NDArray[np.integer]) -> Floats:
    """Return the variance per axis of the error that all views share, which no residual shows.

    It is (bias (1 + OCCLUDED missing))^2, where `missing` is the share of the views of a person
    that are no inliers for the joint.

    Args:
        bias: (joints,) its standard deviation where all views agree [m].
        views: (frames, persons, joints) inlier views.
        seen: (frames, persons) views of the person.
    """
    missing = 1.0 - views / np.maximum(seen, 1)[..., None]
    variance: Floats = (bias * (1.0 + OCCLUDED * missing)) ** 2
    return variance


@dataclass(frozen=True)
class Proportion:
    """Body length that hardly depends on the pose.

    Attributes:
        ends: one or two pairs of ends; an end is the mean of its joints.
        share: share of stature [1].
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
    return Proportion(tuple(((a,), (b,)) for a, b in pairs), share, 0.03, 2.0)


def _breadth(name: str, share: float, spread: float) -> Proportion:
    left, right = COCO17.index(f"left_{name}"), COCO17.index(f"right_{name}")
    # Both ends move outward together.
    return Proportion((((left,), (right,)),), share, spread, 4.0)


PROPORTIONS: Final = (
    _limb("shoulder", "elbow", 0.162),
    _limb("elbow", "wrist", 0.154),
    _limb("hip", "knee", 0.2425),
    _limb("knee", "ankle", 0.249),
    _breadth("shoulder", 0.205, 0.07),
    _breadth("hip", 0.098, 0.08),
    Proportion((((5, 6), (11, 12)),), 0.294, 0.05, 2.0),
)
"""Limbs and trunk between joint centres of men after P. de Leva, Journal of Biomechanics 29, 1996;
published breadths between the centres of shoulders and hips agree less."""
STATURE: Final = (1.72, 0.12)
"""Stature of people, mean and standard deviation per clip [m]: men, women or children."""
PERSONAL: Final = 0.035
"""Standard deviation of a person's proportion relative to the mean [1] (Drillis, Contini 1966)."""


def learn_common_bias(joints: Floats, covariance: Floats, usual: float) -> float:
    """Return the estimated common bias per axis of a joint [m].

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
    # The prior of the bias variance is inverse chi-square with eight degrees of freedom.
    posterior = -8.0 * (np.log(factors) + 0.5 / factors**2)
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
        middle = float(np.median(square[there, person])) if there.sum() >= 5 else 0.0
        if middle > 0.0:
            lengths.append(np.sqrt(middle))
            # Detector errors persist over many frames, so all frames count as one observation.
            noises.append(float(np.median(trace[there, person])) / 3.0)
    if not lengths:
        return 0.0, 0.0, 0
    return float(np.median(lengths)), float(np.mean(noises)) / len(lengths), len(lengths)
