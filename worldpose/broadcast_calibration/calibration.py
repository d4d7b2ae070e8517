"""Calibration of every frame of a broadcast clip from a few key frames (M1 to M6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.broadcast_calibration import FRAME_STATUS, KeyFrame
from worldpose.broadcast_calibration.evidence import (
    CLICK,
    MARKING,
    FlowEvidence,
    PointEvidence,
    join_evidence,
    spread_noise,
)
from worldpose.broadcast_calibration.key_frames import calibrate_keys
from worldpose.broadcast_calibration.line_evidence import FieldSamples, follow_lines
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.pitch_errors import SIZES, PitchErrors, PitchFit
from worldpose.broadcast_calibration.players import (
    FeedOffset,
    People,
    PlayerNoise,
    estimate_feed_offset,
    match,
    player_evidence,
)
from worldpose.broadcast_calibration.priors import (
    Weights,
    build_prior,
    correlation_time,
    estimate_flow_share,
    estimate_smoothness,
)
from worldpose.broadcast_calibration.report import (
    BroadcastReport,
    JointFit,
    TrackedClip,
    pixel_residuals,
    report_calibration,
)
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.shots import require_one_shot
from worldpose.broadcast_calibration.solver import Problem, Solution, descend, displace, solve
from worldpose.broadcast_calibration.tracking import (
    Chain,
    Followed,
    chain,
    follow,
)
from worldpose.broadcast_calibration.uncertainty import (
    Uncertainty,
    compute_uncertainty,
    lasting_samples,
    moving_arrays,
    paint_variance,
)
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera, camera_arrays, camera_from_arrays
from worldpose.pitch.template import PitchTemplate

Pictures = Callable[[], Iterator[Image]]
"""Starts a new pass over all frames of the clip, grey (height, width), in order."""


@dataclass(frozen=True, eq=False)
class BroadcastCalibration:
    """A moving camera, its covariance and its report.

    Attributes:
        camera: all frames.
        uncertainty: its covariance.
        report: residuals, drift, frames to click next.
        tracked: camera from key frames and followed points alone, before any refinement.
        before: `tracked` with rotation and focal length of each frame corrected on its painted
            lines, before players and the joint fit.
    """

    camera: MovingCamera
    uncertainty: Uncertainty
    report: BroadcastReport
    tracked: MovingCamera
    before: MovingCamera


@dataclass(frozen=True, eq=False)
class BroadcastClip:
    """Images, key frames and people of one clip.

    Attributes:
        key_frames: clicks in one frame or more.
        pictures: starts a new pass over the clip's grey frames: one to track, and one per
            iteration.
        fps: frames per second.
        people: joints of the static cameras, and keypoints in the clip; None = markings alone.
        boxes: (frames, detections, 4) x0 y0 x1 y1 [px] of moving people in the frames; those of
            `people` if None.
        where: clip or file, for messages.
        first: number of the clip's first frame in its video; key frames and messages use the
            numbers of the video.
        proposed: the key frames are proposals: they start the fit and are no evidence in it, since
            they come from the paint that the fit measures in every frame.
    """

    key_frames: Sequence[KeyFrame]
    pictures: Pictures
    fps: float
    people: People | None = None
    boxes: Floats | None = None
    where: str = "broadcast clip"
    first: int = 0
    proposed: bool = False

    @property
    def moving_boxes(self) -> Floats | None:
        """Boxes (frames, detections, 4) [px] of moving people; None without any."""
        if self.boxes is None and self.people is not None:
            return self.people.boxes
        return self.boxes


def calibrate_broadcast(
    pitch: PitchTemplate,
    clip: BroadcastClip,
    settings: BroadcastCalibrationSettings = BroadcastCalibrationSettings(),  # noqa: B008
) -> BroadcastCalibration:
    """Return the calibrated camera of every frame.

    The steps are: calibrate key frames with one center; follow static points from frame to frame;
    detect painted lines in every frame; match players of the static cameras with detections in the
    clip; fit all frames jointly.

    Args:
        pitch: the stadium's template.
        clip: images, key frames and people.
        settings: weights, noise and gates.

    Raises:
        InputError: the clip has cuts, or no key frame is usable.
        DegenerateError: the evidence does not determine the camera of every frame.

    Note:
        M1 to M6; paper section "Broadcasting Camera Calibration" and its supplement.
    """
    return refine(pitch, clip, track(pitch, clip, settings), settings)


def track(
    pitch: PitchTemplate, clip: BroadcastClip, settings: BroadcastCalibrationSettings
) -> TrackedClip:
    """Return cameras from key frames and followed points (M2); see `calibrate_broadcast`."""
    key_frames, where, first = clip.key_frames, clip.where, clip.first
    wanted = {key.frame - first for key in key_frames}
    if len(wanted) < len(key_frames):
        raise InputError(
            where,
            expected="every key frame once",
            found=f"{sorted(key.frame for key in key_frames)}",
            todo="Put all clicks of a frame into one entry.",
        )
    kept: dict[int, Image] = {}
    followed = follow(
        _keep_frames(clip.pictures(), wanted, kept), clip.moving_boxes, settings.flow_points
    )
    missing = sorted(wanted - set(kept))
    if missing:
        raise InputError(
            where,
            expected=f"key frames from {first} to {first + len(followed)}",
            found=f"{[first + number for number in missing]}",
            todo="Number frames as the video has them, from 0.",
        )
    require_one_shot(followed, settings.cut_share, where, first)
    height, width = next(iter(kept.values())).shape
    keys = calibrate_keys(pitch, key_frames, (width, height), kept, settings, where, first)
    links = chain([int(n) for n in keys.frames], keys.camera, followed, settings.flow_outlier)
    return TrackedClip(keys, links, _select_flow(followed, links, settings))


def refine(
    pitch: PitchTemplate,
    clip: BroadcastClip,
    tracked: TrackedClip,
    settings: BroadcastCalibrationSettings,
) -> BroadcastCalibration:
    """Return the joint fit of all frames (M3 to M6); see `calibrate_broadcast`."""
    people, boxes, fps = clip.people, clip.moving_boxes, clip.fps
    learned = _Learned(PitchErrors.of(pitch, settings))
    first_errors = learned.errors
    camera = tracked.chain.camera
    spread = estimate_smoothness(camera, fps)
    if not settings.smooth:
        # Smoothness of the rotation still bridges frames without evidence.
        spread[3:] = np.inf
    clicks = replace(tracked.keys.clicks, frame=tracked.keys.frames[tracked.keys.clicks.frame])
    if clip.proposed:
        clicks = PointEvidence.none()
    deviation = float(tracked.flow.deviation[0]) if len(tracked.flow) else 0.0
    share = estimate_flow_share(
        tracked.chain, tracked.keys.frames, deviation, settings.flow_drift_px
    )
    terms = _Terms(tracked.flow, share, spread, settings)
    noise, matches = PlayerNoise(0.0, 0.0), None
    surface = tracked.keys.surface
    offset: FeedOffset | None = None
    before = camera
    for number in range(settings.passes):  # one or more
        samples = FieldSamples.of(pitch, learned.errors, surface)
        lines, corrected = follow_lines(camera, samples, clip.pictures(), boxes, settings)
        before = corrected if number == 0 else before
        parts = [learned.errors.rescale(clicks, first_errors), lines]
        if people is not None and settings.player_weight > 0.0:
            if offset is None:
                # Before any fit includes these players.
                offset = estimate_feed_offset(corrected, people)
                if settings.feed_offset == "correct" and offset.determined:
                    people = people.later(offset.frames)
            matches = match(corrected, people)
            players, noise = player_evidence(corrected, people, matches, settings)
            parts.append(players)
        problem, solution, learned = _fit_and_learn(join_evidence(parts), corrected, learned, terms)
        camera = solution.camera
        shown = problem.of_size(solution.paint_offsets)
        surface = pitch.surface + (learned.errors.size_m * shown)[2:]
    if settings.solver == "adam":
        solution = descend(tracked.chain.camera, problem, settings.adam_iterations)
    lasting = correlation_time(tracked.chain.camera, fps)
    uncertainty = compute_uncertainty(
        solution, problem, settings.line_shift_px, settings.player_shift, lasting
    )
    weights = Weights(
        flow_deviation_px=deviation,
        flow_share=share,
        smooth_log_focal=_finite_or_zero(spread[3]),
        smooth_k1=_finite_or_zero(spread[4]),
        smooth_k2=_finite_or_zero(spread[5]),
        smooth_frames=lasting,
        player_share=noise.share,
        player_frames=noise.frames,
    )
    fit = JointFit(
        solution.camera,
        before,
        uncertainty,
        _displace_by_size(problem, solution),
        matches,
        weights,
        offset,
        learned.describe(pitch, problem, solution),
    )
    report = report_calibration(tracked, fit, pitch, settings, clip.first)
    return BroadcastCalibration(solution.camera, uncertainty, report, tracked.chain.camera, before)


@dataclass(frozen=True, eq=False)
class _Learned:
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

    def is_near(self, other: _Learned) -> bool:
        """Return whether another fit would change little."""
        ratio = 1.05  # of two spreads that count as equal
        pairs = (
            (self.errors.paint_m, other.errors.paint_m),
            (self.lines, other.lines),
            (self.clicks, other.clicks),
            (self.lasting, other.lasting),
        )
        return all(1.0 / ratio < one / two < ratio for one, two in pairs)

    def describe(self, pitch: PitchTemplate, problem: Problem, solution: Solution) -> PitchFit:
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
            paint_m=0.0 if self.errors.surveyed.all() else self.errors.paint_m,
            line_noise=self.lines,
            click_noise=self.clicks,
        )


def _learn(problem: Problem, solution: Solution, learned: _Learned) -> _Learned:
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
    return _Learned(errors, float(lines), float(clicks), max(1.0, lasting))


def _displace_by_size(problem: Problem, solution: Solution) -> PointEvidence:
    """Return the evidence of a fit with places on the pitch of the estimated size."""
    size = solution.paint_offsets.copy()
    size[: len(problem.painted)] = 0.0
    return displace(problem.points, problem, size)


@dataclass(frozen=True, eq=False)
class _Terms:
    """Terms of a clip's fit that stay the same in all passes.

    Attributes:
        flow: followed points.
        share: factor on a followed point's loss [1].
        spread: (7,) standard deviation of second differences.
        settings: weights, noise and gates.
    """

    flow: FlowEvidence
    share: float
    spread: Floats
    settings: BroadcastCalibrationSettings

    def pose(self, points: PointEvidence, learned: _Learned, camera: MovingCamera) -> Problem:
        """Return the fit of evidence, of the assumed noise, at the learned noise."""
        settings = self.settings
        return Problem(
            points=learned.scale_noise(points),
            flow=self.flow,
            prior=build_prior(settings.prior, camera.focal, camera.image_size),
            smoothness=self.spread,
            flow_weight=self.share / learned.lasting * settings.flow_weight,
            flow_loss=settings.loss_scale,
        )


def _fit_and_learn(
    points: PointEvidence, camera: MovingCamera, learned: _Learned, terms: _Terms
) -> tuple[Problem, Solution, _Learned]:
    """Return fits that alternate with the spreads that their residuals show, until these settle."""
    for left in reversed(range(4)):
        problem = terms.pose(points, learned, camera)
        solution = solve(camera, problem, terms.settings.max_iterations)
        camera, before = solution.camera, learned
        learned = _learn(problem, solution, learned)
        if left == 0 or learned.is_near(before):
            break
        points = learned.errors.rescale(points, before.errors)
    return problem, solution, learned


def _select_flow(
    followed: Sequence[Followed], links: Chain, settings: BroadcastCalibrationSettings
) -> FlowEvidence:
    """Return the followed points consistent with the camera, with their measured deviation."""
    kept = links.kept
    counts = [int(mine.sum()) for mine in kept]
    none = np.empty((0, 2))
    residual = np.concatenate([none, *(r[m] for r, m in zip(links.residual, kept, strict=True))])
    seen = 1.4826 * float(np.median(np.abs(residual))) if len(residual) else 0.0
    return FlowEvidence(
        frame=np.repeat(np.arange(len(followed)), counts),
        start=np.concatenate([none, *(p.start[m] for p, m in zip(followed, kept, strict=True))]),
        end=np.concatenate([none, *(p.end[m] for p, m in zip(followed, kept, strict=True))]),
        deviation=np.full(sum(counts), max(seen, settings.flow_noise_px)),
    )


def _keep_frames(
    pictures: Iterator[Image], wanted: set[int], kept: dict[int, Image]
) -> Iterator[Image]:
    """Yield all frames, and store the wanted ones in `kept`."""
    for number, picture in enumerate(pictures):
        if number in wanted:
            kept[number] = picture
        yield picture


def _finite_or_zero(value: float) -> float:
    """Return a spread for a record, which cannot hold infinity: 0 means none."""
    return float(value) if np.isfinite(value) else 0.0


def broadcast_arrays(calibration: BroadcastCalibration) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a calibrated clip, by name, without the frame numbers."""
    report, before = calibration.report, camera_arrays(calibration.before.camera)
    del before["image_size"]
    return {
        **moving_arrays(calibration.camera, calibration.uncertainty),
        **{f"{name}_before": array for name, array in before.items()},
        "status": report.status,
        "reprojection_error": report.reprojection_error,
        "marking_rms": report.marking_rms,
        "player_rms": report.player_rms,
        "marking_count": report.marking_count.astype(np.int32),
        "player_count": report.player_count.astype(np.int32),
        "flow_count": report.flow_count.astype(np.int32),
    }


def camera_before(arrays: Mapping[Any, ArrayLike]) -> Camera:
    """Return the stored camera (frames,) before players and the joint fit."""
    ends = "_before"
    stored = {name.removesuffix(ends): arrays[name] for name in arrays if name.endswith(ends)}
    return camera_from_arrays({**stored, "image_size": arrays["image_size"]})


def broadcast_attributes(
    clip_id: str, calibration: BroadcastCalibration, first: int = 0
) -> dict[str, Any]:
    """Return the stored attributes of a calibrated clip, with frame numbers of its video.

    Args:
        clip_id: the clip.
        calibration: its camera.
        first: number of its first frame in its video.
    """
    report, offset = calibration.report, calibration.report.feed_offset
    spec = report.pitch.spec
    return {
        "clip_id": clip_id,
        "status_names": list(FRAME_STATUS),
        "key_frames": [first + int(frame) for frame in report.key_frames],
        "refused_key_frames": {str(first + frame): why for frame, why in report.refused.items()},
        "weights": report.weights.model_dump(),
        "feed_offset": None
        if offset is None
        else {
            "frames": offset.frames if offset.determined else None,
            "standard_error": offset.standard_error if offset.determined else None,
            "pairs": offset.pairs,
        },
        "drift": [float(drift) for drift in report.drift],
        "pick_next": [first + frame for frame in report.pick_next],
        "markings_off": _finite_or_none(report.markings_off),
        "players_off": _finite_or_none(report.players_off),
        "pitch": None
        if spec is None
        else {
            **spec.model_dump(mode="json", include={*SIZES, "points"}),
            "std_m": report.pitch.size_std.tolist(),
        },
        "noise": {
            "paint_m": report.pitch.paint_m,
            "lines": report.pitch.line_noise,
            "clicks": report.pitch.click_noise,
        },
        "decisions": list(report.decisions),
        "reasons": list(report.reasons),
    }


def _finite_or_none(values: tuple[float, float]) -> list[float | None]:
    """Return values for a record, which cannot hold NaN."""
    return [value if np.isfinite(value) else None for value in values]
