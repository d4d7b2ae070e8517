"""Calibration of every frame of a broadcast clip from a few key frames (M1 to M6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_contracts.arrays import Floats, Image
from data_contracts.broadcast_calibration import KeyFrame
from worldpose.broadcast_calibration.adam import descend
from worldpose.broadcast_calibration.chain import Chain, chain
from worldpose.broadcast_calibration.cuts import require_one_shot
from worldpose.broadcast_calibration.evidence import (
    FlowEvidence,
    PointEvidence,
    together,
)
from worldpose.broadcast_calibration.feed_offset import FeedOffset, estimate_feed_offset
from worldpose.broadcast_calibration.key_frames import Keys, calibrate_keys
from worldpose.broadcast_calibration.line_evidence import FieldSamples, follow_lines
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.optical_flow import Followed, follow
from worldpose.broadcast_calibration.players import (
    People,
    PlayerNoise,
    match,
    player_evidence,
)
from worldpose.broadcast_calibration.priors import prior_of
from worldpose.broadcast_calibration.report import BroadcastReport, report_of
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.solving import Problem, Solution, solve
from worldpose.broadcast_calibration.uncertainty import Uncertainty, uncertainty_of
from worldpose.broadcast_calibration.weights import (
    Weights,
    flow_share_of,
    lasting_of,
    smoothness_of,
)
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate

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
class Tracked:
    """A clip before refinement: its key frames, and the chain of cameras between them.

    Attributes:
        keys: calibrated key frames.
        chain: an initial camera for every frame.
        flow: followed points consistent with the chain.
    """

    keys: Keys
    chain: Chain
    flow: FlowEvidence


def calibrate_broadcast(
    pitch: PitchTemplate,
    key_frames: Sequence[KeyFrame],
    pictures: Pictures,
    fps: float,
    *,
    people: People | None = None,
    boxes: Floats | None = None,
    settings: BroadcastCalibrationSettings = BroadcastCalibrationSettings(),  # noqa: B008
    where: str = "broadcast clip",
    first: int = 0,
) -> BroadcastCalibration:
    """Return the calibrated camera of every frame.

    The steps are: calibrate key frames with one center; follow static points from frame to frame;
    detect painted lines in every frame; match players of the static cameras with detections in the
    clip; fit all frames jointly.

    Args:
        pitch: the stadium's template.
        key_frames: clicks in one frame or more.
        pictures: starts a new pass over the clip's grey frames: one to track, and one per
            iteration.
        fps: frames per second.
        people: joints of the static cameras, and keypoints in the clip; None = markings alone.
        boxes: (frames, detections, 4) x0 y0 x1 y1 [px] of moving people in the frames; those of
            `people` if None.
        settings: weights, noise and gates.
        where: clip or file, for messages.
        first: number of the clip's first frame in its video; key frames and messages use the
            numbers of the video.

    Raises:
        InputError: the clip has cuts, or no key frame is usable.
        DegenerateError: the evidence does not determine a frame.

    Note:
        M1 to M6; paper section "Broadcasting Camera Calibration" and its supplement.
    """
    if boxes is None and people is not None:
        boxes = people.boxes
    tracked = track(pitch, key_frames, pictures, boxes, settings, where, first)
    return refine(pitch, tracked, pictures, fps, people, boxes, settings, first)


def track(
    pitch: PitchTemplate,
    key_frames: Sequence[KeyFrame],
    pictures: Pictures,
    boxes: Floats | None,
    settings: BroadcastCalibrationSettings,
    where: str,
    first: int = 0,
) -> Tracked:
    """Return cameras from key frames and followed points (M2); see `calibrate_broadcast`."""
    wanted = {key.frame - first for key in key_frames}
    if len(wanted) < len(key_frames):
        raise InputError(
            where,
            expected="every key frame once",
            found=f"{sorted(key.frame for key in key_frames)}",
            todo="Put all clicks of a frame into one entry.",
        )
    kept: dict[int, Image] = {}
    followed = follow(_keeping(pictures(), wanted, kept), boxes, settings.flow_points)
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
    return Tracked(keys, links, _flow(followed, links, settings))


def refine(
    pitch: PitchTemplate,
    tracked: Tracked,
    pictures: Pictures,
    fps: float,
    people: People | None,
    boxes: Floats | None,
    settings: BroadcastCalibrationSettings,
    first: int = 0,
) -> BroadcastCalibration:
    """Return the joint fit of all frames (M3 to M6); see `calibrate_broadcast`."""
    samples = FieldSamples.of(pitch)
    camera = tracked.chain.camera
    spread = smoothness_of(camera, fps)
    if not settings.smooth:
        # Smoothness of the rotation still bridges frames without evidence.
        spread[3:] = np.inf
    clicks = replace(tracked.keys.clicks, frame=tracked.keys.frames[tracked.keys.clicks.frame])
    deviation = float(tracked.flow.deviation[0]) if len(tracked.flow) else 0.0
    share = flow_share_of(tracked.chain, tracked.keys.frames, deviation, settings.flow_drift)
    noise, matches = PlayerNoise(0.0, 0.0), None
    solution: Solution | None = None
    offset: FeedOffset | None = None
    points, before = clicks, camera
    for number in range(settings.rounds):
        lines = follow_lines(camera, samples, pictures(), boxes, settings)
        before = lines.camera if number == 0 else before
        parts = [clicks, lines.evidence]
        if people is not None and settings.player_weight > 0.0:
            if offset is None:
                # Before any fit includes these players.
                offset = estimate_feed_offset(lines.camera, people)
                if settings.feed_offset == "correct" and offset.determined:
                    people = people.later(offset.frames)
            matches = match(lines.camera, people)
            players, noise = player_evidence(lines.camera, people, matches, settings)
            parts.append(players)
        points = together(parts)
        problem = _problem(points, tracked.flow, share, lines.camera, spread, settings)
        solution = solve(lines.camera, problem, settings.iterations)
        camera = solution.camera
    assert solution is not None  # settings require one iteration or more
    if settings.solver == "adam":
        solution = descend(tracked.chain.camera, problem, settings.adam_iterations)
    lasting = lasting_of(tracked.chain.camera, fps)
    shifts = settings.line_shift, settings.player_shift
    uncertainty = uncertainty_of(solution, problem, *shifts, lasting)
    weights = Weights(
        flow_deviation_px=deviation,
        flow_share=share,
        smooth_log_focal=_number(spread[3]),
        smooth_k1=_number(spread[4]),
        smooth_k2=_number(spread[5]),
        smooth_frames=lasting,
        player_share=noise.share,
        player_frames=noise.frames,
    )
    report = report_of(
        solution.camera, before, uncertainty, points, tracked.flow, tracked.keys, tracked.chain,
        matches, weights, pitch, settings, offset, first,
    )  # fmt: skip
    return BroadcastCalibration(solution.camera, uncertainty, report, tracked.chain.camera, before)


def _problem(
    points: PointEvidence,
    flow: FlowEvidence,
    share: float,
    camera: MovingCamera,
    spread: Floats,
    settings: BroadcastCalibrationSettings,
) -> Problem:
    return Problem(
        points=points,
        flow=flow,
        prior=prior_of(settings.prior, camera.focal, camera.image_size),
        smoothness=spread,
        flow_weight=share * settings.flow_weight,
        flow_loss=settings.loss,
    )


def _flow(
    followed: Sequence[Followed], links: Chain, settings: BroadcastCalibrationSettings
) -> FlowEvidence:
    """Return the followed points consistent with the camera, with their measured deviation."""
    kept = links.kept
    counts = [int(mine.sum()) for mine in kept]
    residual = np.concatenate(
        [np.empty((0, 2)), *(r[mine] for r, mine in zip(links.residual, kept, strict=True))]
    )
    seen = 1.4826 * float(np.median(np.abs(residual))) if len(residual) else 0.0
    return FlowEvidence(
        frame=np.repeat(np.arange(len(followed)), counts),
        start=_stacked([p.start[mine] for p, mine in zip(followed, kept, strict=True)]),
        end=_stacked([p.end[mine] for p, mine in zip(followed, kept, strict=True)]),
        deviation=np.full(sum(counts), max(seen, settings.flow_noise)),
    )


def _stacked(parts: Sequence[Floats]) -> Floats:
    return np.concatenate([np.empty((0, 2)), *parts])


def _keeping(
    pictures: Iterator[Image], wanted: set[int], kept: dict[int, Image]
) -> Iterator[Image]:
    """Yield all frames, and store the wanted ones in `kept`."""
    for number, picture in enumerate(pictures):
        if number in wanted:
            kept[number] = picture
        yield picture


def _number(value: float) -> float:
    """Return a spread for a record, which cannot hold infinity: 0 means none."""
    return float(value) if np.isfinite(value) else 0.0
