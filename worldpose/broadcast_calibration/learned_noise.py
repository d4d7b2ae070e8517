"""Noise and weights that a clip's own tracking and residuals show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.records import Record
from worldpose.broadcast_calibration.clip_problem import ClipProblem
from worldpose.broadcast_calibration.evidence import CLICK, MARKING, PointEvidence, spread_noise
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.pitch_errors import SIZES, PitchErrors, PitchFit
from worldpose.broadcast_calibration.residuals import pixel_residuals
from worldpose.broadcast_calibration.solver import ClipSolution, displace
from worldpose.broadcast_calibration.tracking import Chain
from worldpose.broadcast_calibration.uncertainty import lasting_samples, paint_variance
from worldpose.pitch.template import PitchTemplate

_WINDOW_S: Final = 0.2
"""Smoothing window of tracked focal lengths before differencing [s]."""


class Weights(Record):
    """Weights of the cost terms, and the rule behind each number."""

    flow_deviation_px: float
    """Deviation of a followed point's motion: 1.4826 times the median absolute residual of the
    inliers along an axis, and at least the setting."""
    flow_share: float
    """Factor on a followed point's loss: the squared ratio of the drift between key frames that
    independent points would cause to the measured drift; errors within a frame are correlated."""
    smooth_log_focal: float
    """Deviation of second differences: their root mean square in the logarithm of the tracked focal
    lengths, smoothed over 0.2 s."""
    smooth_frames: float
    """Correlation time of these second differences: the sum of their autocorrelation [frame]."""
    player_share: float
    """Deviation of a keypoint over the person's height: 1.4826 times the median absolute
    residual."""
    player_frames: float
    """Correlation time of a person's errors: the sum of their autocorrelation [frame]."""


def estimate_smoothness(camera: MovingCamera, fps: float) -> Floats:
    """Return the deviation (4,) of second differences in a tracked clip."""
    # At 50 frames per second: it bridges frames without evidence and does not affect others.
    turn = 2e-3 * (50.0 / fps) ** 2
    width, zoom = max(1, round(_WINDOW_S * fps)), 1.0
    if len(camera) >= 3 * width:
        zoom = max(float(np.sqrt(np.mean(_zoom_changes(camera, width) ** 2))), 1e-5)
    return np.array([turn, turn, turn, zoom])


def correlation_time(camera: MovingCamera, fps: float) -> float:
    """Return the correlation time of second differences of a tracked clip's zoom [frame].

    The correlation time is the sum of the autocorrelation: this number of consecutive frames has
    the information of one independent frame.
    """
    width = max(1, round(_WINDOW_S * fps))
    if len(camera) < 3 * width:
        return 1.0
    bends = _zoom_changes(camera, width)
    power, total = float(np.mean(bends**2)), 1.0
    for lag in range(1, len(bends) // 2):
        correlation = float(np.mean(bends[lag:] * bends[:-lag])) / max(power, 1e-300)
        if correlation < 0.05:
            break
        total += 2.0 * correlation
    return total


def _zoom_changes(camera: MovingCamera, width: int) -> Floats:
    """Return second differences of the log focal length, smoothed over `width` frames."""
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()
    padded = np.pad(np.log(camera.focal), width, mode="reflect", reflect_type="odd")
    return np.diff(np.convolve(padded, window, mode="same")[width:-width], n=2)


def estimate_flow_share(
    links: Chain, key_frames: Integers, deviation: float, drift: float
) -> float:
    """Return the factor on a followed point's loss [0..1], with its deviation [px].

    Without a gap between key frames, the drift [px] applies: the tracking error after one frame,
    growing with the square root of frames.
    """
    points = np.array([kept.sum() for kept in links.kept])
    if not len(points) or points.max() == 0:
        return 1.0
    # Four parameters per pair from twice as many coordinates as points.
    independent = deviation * np.sqrt(4.0 / np.median(points[points > 0]))
    known = [links.determined[begin:end].all() for begin, end in pairwise(key_frames)]
    whole = np.isfinite(links.drift) & np.array(known, dtype=np.bool_)
    if whole.any():
        drift = float(np.sqrt(np.mean((links.drift**2 / np.diff(key_frames))[whole])))
    return float(min(1.0, (independent / max(drift, 1e-6)) ** 2))


@dataclass(frozen=True, eq=False)
class LearnedNoise:
    """Spreads that the residuals of a clip show.

    Attributes:
        errors: errors of the pitch.
        lines: deviation of a line's sample over its assumed one, at least 1 [1].
        clicks: the same ratio for clicks [1].
        lasting: samples of lines that count as one, since the errors of a piece of a marking last
            for the whole clip [1].
    """

    errors: PitchErrors
    lines: float = 1.0
    clicks: float = 1.0
    lasting: float = 1.0

    def scale_noise(self, points: PointEvidence) -> PointEvidence:
        """Return evidence of the assumed noise with the learned noise."""
        factor = np.ones(len(points))
        factor[points.kind == MARKING] = self.lines
        factor[points.kind == CLICK] = self.clicks
        whitening = points.whitening / factor[:, None, None]
        return spread_noise(replace(points, whitening=whitening), self.lasting)

    def is_near(self, other: LearnedNoise) -> bool:
        """Return whether another fit would change little."""
        ratio = 1.05  # of two spreads that count as equal
        pairs = (
            (self.errors.paint_m, other.errors.paint_m),
            (self.lines, other.lines),
            (self.clicks, other.clicks),
            (self.lasting, other.lasting),
        )
        return all(1.0 / ratio < one / two < ratio for one, two in pairs)

    def describe(
        self, pitch: PitchTemplate, problem: ClipProblem, solution: ClipSolution
    ) -> PitchFit:
        """Return the pitch and the noise for the report."""
        offset = problem.of_size(solution.paint_offsets)
        std = np.sqrt(problem.of_size(paint_variance(solution)))
        rows = np.flatnonzero(~self.errors.surveyed[problem.painted])
        points = problem.painted[rows]
        names, places = list(pitch.points), np.array(list(pitch.points.values()))[points]
        own = np.column_stack([points, np.full(len(points), -1)])
        by_size = self.errors.displacement_by_size(own, np.ones(own.shape), places)
        places = places + self.errors.point_m[points, None] * solution.paint_offsets[rows]
        places = places + by_size[:, 0] * offset[:3]
        places[:, 2] += by_size[:, 1, 2] * offset[3]
        return PitchFit(
            points={names[point]: place for point, place in zip(points, places, strict=True)},
            size=np.array([getattr(pitch, name) for name in SIZES]) + self.errors.size_m * offset,
            size_std=self.errors.size_m * std,
            paint_m=0.0 if self.errors.surveyed.all() else self.errors.shown_m,
            line_noise=self.lines,
            click_noise=self.clicks,
        )


def learn_noise(
    problem: ClipProblem, solution: ClipSolution, learned: LearnedNoise
) -> LearnedNoise:
    """Return the spreads that the residuals of a fit show."""
    prior = 10.0  # coordinates that the assumed noise of clicks is worth
    points = displace(problem.points, problem, solution.paint_offsets)
    off = np.clip(pixel_residuals(solution.camera, points), -1e6, 1e6)
    white = np.abs(np.einsum("nij,nj->ni", points.whitening, off))
    lines, clicks = learned.lines, learned.clicks
    across = white[points.kind == MARKING, 0]
    if len(across):
        lines = max(1.0, lines * 1.4826 * float(np.median(across)) * np.sqrt(learned.lasting))
    clicked = points.kind == CLICK
    used = white[clicked][np.abs(points.whitening[clicked]).any(axis=-1)]
    if len(used):
        squares = float((np.minimum(used, points.loss[clicked].max()) ** 2).sum())
        clicks *= np.sqrt((prior + squares) / (prior + len(used)))
    painted = len(problem.painted)
    errors = learned.errors
    if not errors.surveyed.all():
        variance = paint_variance(solution)[:painted]
        errors = errors.learn_paint(solution.paint_offsets[:painted], variance, problem.painted)
    lasting = lasting_samples(points, off) * learned.lasting
    return LearnedNoise(errors, float(lines), float(clicks), max(1.0, lasting))


def displace_by_size(problem: ClipProblem, solution: ClipSolution) -> PointEvidence:
    """Return the evidence of a fit with places on the pitch of the estimated size."""
    size = solution.paint_offsets.copy()
    size[: len(problem.painted)] = 0.0
    return displace(problem.points, problem, size)
