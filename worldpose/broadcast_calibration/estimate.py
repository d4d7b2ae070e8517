"""Calibration of every frame of a broadcast clip from a few key frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_contracts.arrays import Floats, Image
from data_contracts.broadcast_calibration import FRAME_STATUS, KeyFrame
from worldpose.broadcast_calibration.clip_problem import ClipProblem, TermWeights
from worldpose.broadcast_calibration.evidence import FlowEvidence, PointEvidence, join_evidence
from worldpose.broadcast_calibration.given_camera import GivenCamera
from worldpose.broadcast_calibration.key_frames import calibrate_keys
from worldpose.broadcast_calibration.learned_noise import (
    LearnedNoise,
    Weights,
    correlation_time,
    displace_by_size,
    estimate_flow_share,
    estimate_smoothness,
    learn_noise,
)
from worldpose.broadcast_calibration.line_evidence import FieldSamples, follow_lines
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.pitch_errors import PitchErrors
from worldpose.broadcast_calibration.players import (
    FeedOffset,
    People,
    PlayerNoise,
    estimate_feed_offset,
    match,
    player_evidence,
)
from worldpose.broadcast_calibration.priors import build_prior, lens_walk
from worldpose.broadcast_calibration.report import (
    BroadcastCalibration,
    BroadcastReport,
    JointFit,
    TrackedClip,
    report_calibration,
)
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.shots import require_one_shot
from worldpose.broadcast_calibration.solver import ClipSolution, solve
from worldpose.broadcast_calibration.tracking import Chain, Followed, chain, follow
from worldpose.broadcast_calibration.uncertainty import compute_uncertainty
from worldpose.errors import InputError
from worldpose.ingest.clock import row_rate
from worldpose.ingest.footage import stretches
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method import require_torch

Pictures = Callable[[], Iterator[Image]]
"""Starts a new pass over all frames of the clip, grey (height, width), in order."""


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
            they come from the paint that the fit measures in every frame, or from `given`.
        smooth_weight: factor on the smoothness of the focal length.
        given: camera data of a tracking system in all frames; None without.
    """

    key_frames: Sequence[KeyFrame]
    pictures: Pictures
    fps: float
    people: People | None = None
    boxes: Floats | None = None
    where: str = "broadcast clip"
    first: int = 0
    proposed: bool = False
    smooth_weight: float = 1.0
    given: GivenCamera | None = None

    def __post_init__(self) -> None:
        row_rate(self.where, self.fps)

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
        Paper section "Broadcasting Camera Calibration" and its supplement.
    """
    return refine(pitch, clip, track(pitch, clip, settings), settings)


def track(
    pitch: PitchTemplate, clip: BroadcastClip, settings: BroadcastCalibrationSettings
) -> TrackedClip:
    """Return cameras from key frames and followed points; see `calibrate_broadcast`."""
    key_frames, where, first = clip.key_frames, clip.where, clip.first
    wanted = {key.frame - first for key in key_frames}
    if len(wanted) < len(key_frames):
        raise InputError(
            where,
            expected="every key frame once",
            found=f"{sorted(key.frame for key in key_frames)}",
            todo="Put all clicks of a frame into one entry.",
        )
    if not key_frames:
        raise InputError(
            where,
            expected="a key frame in the clip, or camera data with angles, place and focal length",
            found="none",
            todo="Click points in a frame that shows an area's corners or the centre circle.",
        )
    kept: dict[int, Image] = {}
    followed = follow(_keep_frames(clip, wanted, kept), clip.moving_boxes, settings.flow_points)
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
    """Return the joint fit of all frames; see `calibrate_broadcast`."""
    people, boxes, fps = clip.people, clip.moving_boxes, clip.fps
    learned = LearnedNoise(PitchErrors.of(pitch, settings))
    first_errors = learned.errors
    camera = tracked.chain.camera
    spread = estimate_smoothness(camera, fps)
    spread[3] /= np.sqrt(clip.smooth_weight)
    if not settings.smooth:
        # Smoothness of the rotation still bridges frames without evidence.
        spread[3] = np.inf
    clicks = replace(tracked.keys.clicks, frame=tracked.keys.frames[tracked.keys.clicks.frame])
    if clip.proposed:
        clicks = PointEvidence.none()
    deviation = float(tracked.flow.deviation[0]) if len(tracked.flow) else 0.0
    share = estimate_flow_share(
        tracked.chain, tracked.keys.frames, deviation, settings.flow_drift_px
    )
    noise, matches, players = PlayerNoise(0.0, 0.0), None, PointEvidence.none()
    surface = tracked.keys.surface
    offset: FeedOffset | None = None
    before = camera
    given, denied = clip.given, ""
    if given is not None:
        keys = camera.frames(tracked.keys.frames)
        denied = given.contradiction(keys, tracked.keys.frames, settings.prior)
    for number in range(settings.passes):  # one or more
        samples = FieldSamples.of(pitch, learned.errors, surface)
        lines, corrected, searched = follow_lines(camera, samples, clip.pictures(), boxes, settings)
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
        prior = build_prior(settings.prior, corrected.focal, corrected.image_size)
        if given is not None and not denied:
            prior = given.add_to(prior, corrected.image_size, settings.prior)
        problem = ClipProblem(
            points=PointEvidence.none(),
            flow=tracked.flow,
            prior=prior,
            weights=TermWeights(
                field=settings.field_weight,
                player=settings.player_weight / max(noise.frames, 1.0),
                flow=settings.flow_weight * share,
            ),
            smoothness=spread,
            lens_walk=lens_walk(corrected.focal) if settings.smooth else None,
            flow_loss=settings.loss_scale,
        )
        problem, solution, learned = _fit_and_learn(
            join_evidence(parts), corrected, learned, problem, settings.max_iterations
        )
        camera = solution.camera
        shown = problem.of_size(solution.paint_offsets)
        surface = pitch.surface + (learned.errors.size_m * shown)[2:]
    if settings.method == "paper":
        solution = _refit_as_paper(pitch, tracked, players, problem, settings)
    lasting = correlation_time(tracked.chain.camera, fps)
    uncertainty = compute_uncertainty(
        solution, problem, settings.line_shift_px, settings.player_shift, lasting
    )
    weights = Weights(
        flow_deviation_px=deviation,
        flow_share=share,
        # 0 means none: a record cannot hold infinity.
        smooth_log_focal=float(spread[3]) if np.isfinite(spread[3]) else 0.0,
        smooth_frames=lasting,
        player_share=noise.share,
        player_frames=noise.frames,
    )
    fit = JointFit(
        solution.camera,
        before,
        uncertainty,
        displace_by_size(problem, solution),
        matches,
        weights,
        offset,
        learned.describe(pitch, problem, solution),
        searched,
    )
    report = report_calibration(tracked, fit, pitch, settings, clip.first)
    if given is not None:
        every = np.arange(len(solution.camera))
        denied = (
            given.contradiction(solution.camera, every, settings.prior) if given.leads else denied
        )
        report = _report_given(clip, given, denied, report, solution.camera)
    _require_markings(clip, report)
    return BroadcastCalibration(solution.camera, uncertainty, report, tracked.chain.camera, before)


def _refit_as_paper(
    pitch: PitchTemplate,
    tracked: TrackedClip,
    players: PointEvidence,
    problem: ClipProblem,
    settings: BroadcastCalibrationSettings,
) -> ClipSolution:
    """Return the camera of least E_calib, the fit with `method=paper`, from that of tracking."""
    require_torch()
    from worldpose.reference_method.broadcast_calibration import refine

    start, lines = tracked.chain.camera, pitch.sample_lines(0.5).points_world
    camera = start.camera
    pixels = camera.project(np.broadcast_to(lines, (len(start), *lines.shape)))
    seen = ((pixels >= 0.0) & (pixels <= start.image_size - 1.0)).all(axis=-1)
    frame, point = np.nonzero(seen)
    # Evenly chosen among those of a frame.
    place = np.arange(len(frame)) - np.searchsorted(frame, frame)
    kept = place % np.maximum(1, -(-seen.sum(axis=1) // settings.line_samples))[frame] == 0
    frame, point = frame[kept], point[kept]
    field = lines[point], pixels[frame, point], frame
    people = players.world, players.image, players.frame
    found = MovingCamera.from_batch(refine(camera, field, people, settings.adam_iterations))
    return ClipSolution.at(found, np.zeros((problem.paint_count, 3)), problem)


def _report_given(
    clip: BroadcastClip,
    given: GivenCamera,
    denied: str,
    report: BroadcastReport,
    camera: MovingCamera,
) -> BroadcastReport:
    """Return a report with the comparison of the camera and its camera data.

    InputError if the camera rests on the data alone, and the paint does not confirm them.
    """
    confirmed = float(np.mean(report.marking_count >= 30))
    if given.leads and (confirmed < 0.5 or denied):
        raise InputError(
            clip.where,
            expected="painted lines where the camera data project them",
            found=f"them in {100.0 * confirmed:.0f} % of the frames, and differences of the data "
            f"from the paint of {denied or 'no weight'}",
            todo="Check axes, signs and first frame of the camera data, or click key frames.",
        )
    reason = f"camera data contradict the key frames, and are no prior: {denied}"
    return replace(
        report,
        decisions=(*report.decisions, *given.describe(camera)),
        reasons=(*report.reasons, *([reason] if denied else [])),
    )


def _require_markings(clip: BroadcastClip, report: BroadcastReport) -> None:
    """Raise InputError if another camera's images follow a dissolve, or images without corners.

    Motion blur and a player before the lens hide markings for less than 0.2 s, or hide some alone.
    """
    unsure = report.contradicted | (report.status == FRAME_STATUS.index("bridged"))
    spans = [
        [clip.first + begin, clip.first + end]
        for begin, end in stretches(np.flatnonzero(unsure))
        if report.contradicted[begin : end + 1].any() and end + 1 - begin >= 0.2 * clip.fps
    ]
    if spans:
        raise InputError(
            clip.where,
            expected="one shot of one camera, and its markings where the camera projects them",
            found=f"no markings there in frames {', '.join(f'{a} to {b}' for a, b in spans)}",
            todo="End the clip before a dissolve or a black image, or click a key frame in these.",
        )


def _fit_and_learn(
    points: PointEvidence,
    camera: MovingCamera,
    learned: LearnedNoise,
    start: ClipProblem,
    iterations: int,
) -> tuple[ClipProblem, ClipSolution, LearnedNoise]:
    """Return fits that alternate with the spreads that their residuals show, until these settle.

    `points` have the assumed noise, `learned` are the spreads so far, and `start` has the terms
    that no spread changes, without points. One fit has so many iterations at most.
    """
    for left in reversed(range(4)):
        weights = start.weights._replace(flow=start.weights.flow / learned.lasting)
        problem = replace(start, points=learned.scale_noise(points), weights=weights)
        solution = solve(camera, problem, iterations)
        camera, before = solution.camera, learned
        learned = learn_noise(problem, solution, learned)
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


def _keep_frames(clip: BroadcastClip, wanted: set[int], kept: dict[int, Image]) -> Iterator[Image]:
    """Yield all frames, and keep the wanted ones; InputError if people or data have others."""
    given = set() if clip.boxes is None else {len(clip.boxes)}
    given |= set() if clip.people is None else {len(clip.people.joints)}
    given |= set() if clip.given is None else {len(clip.given.values)}
    count, pictures = 0, clip.pictures()
    for count, picture in enumerate(pictures, 1):
        if given and count > min(given):
            count += sum(1 for _ in pictures)
            break
        if count - 1 in wanted:
            kept[count - 1] = picture
        yield picture
    if given - {count}:
        raise InputError(
            clip.where,
            expected="people, boxes and camera data of every picture of the clip",
            found=f"{count} pictures, and data of {', '.join(map(str, sorted(given)))}",
            todo="Give rows for all pictures, NaN where nothing is known.",
        )
