"""Report of a broadcast calibration: status, residuals and expected errors per frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Flags, Floats, Image, Integers
from data_contracts.broadcast_calibration import FRAME_STATUS
from worldpose.broadcast_calibration.evidence import MARKING, PLAYER, FlowEvidence, PointEvidence
from worldpose.broadcast_calibration.key_frames import Keys
from worldpose.broadcast_calibration.learned_noise import Weights
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.pitch_errors import PitchFit
from worldpose.broadcast_calibration.players import FeedOffset, Matches
from worldpose.broadcast_calibration.residuals import pixel_residuals
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.tracking import Chain
from worldpose.broadcast_calibration.uncertainty import Uncertainty, moving_arrays
from worldpose.geometry.cameras import Camera, camera_arrays, camera_from_arrays
from worldpose.pitch.template import PitchTemplate


@dataclass(frozen=True, eq=False)
class BroadcastReport:
    """Accuracy of a clip's camera, its evidence and warnings.

    Attributes:
        status: (frames,) main evidence of each frame, an index into FRAME_STATUS.
        reprojection_error: (frames,) expected image error of places on the pitch, root mean square
            over the visible places [px].
        marking_rms: (frames,) root mean square residual of the samples of painted lines, across the
            lines [px]; NaN without any.
        player_rms: (frames,) root mean square residual of matched keypoints [px]; NaN without any.
        marking_count: (frames,) samples of painted lines.
        player_count: (frames,) matched players.
        flow_count: (frames,) followed points from the frame to the next.
        key_frames: used key frames.
        refused: unusable key frames and the reasons.
        wrong: outliers among a key frame's clicks and markings, by frame.
        contradicted: (frames,) whether the frame lacks markings that other frames show.
        drift: (gaps,) tracking error from one key frame to the next [px].
        feed_offset: the clip's clock offset, from people; None without people.
        weights: weights of the terms.
        pitch: the pitch and the noise that the fit shows.
        pick_next: frames whose clicks would help most, the best first.
        markings_off: median distance of painted lines from their projection [px], before players
            and the joint fit, and after; NaN without any.
        players_off: the same distances of people, by the mean over a person's keypoints.
        decisions: choices and the metrics behind them.
        reasons: why a person must review the clip; empty if not necessary.
    """

    status: Image
    reprojection_error: Floats
    marking_rms: Floats
    player_rms: Floats
    marking_count: Integers
    player_count: Integers
    flow_count: Integers
    key_frames: Integers
    refused: Mapping[int, str]
    wrong: Mapping[int, tuple[str, ...]]
    contradicted: Flags
    drift: Floats
    feed_offset: FeedOffset | None
    weights: Weights
    pitch: PitchFit
    pick_next: tuple[int, ...]
    markings_off: tuple[float, float]
    players_off: tuple[float, float]
    decisions: tuple[str, ...]
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class TrackedClip:
    """A clip before refinement: its key frames, an initial camera for every frame between them.

    `flow` are followed points consistent with the chain of these cameras.
    """

    keys: Keys
    chain: Chain
    flow: FlowEvidence


@dataclass(frozen=True, eq=False)
class JointFit:
    """The joint fit of all frames, and what it rests on.

    Attributes:
        camera: all frames.
        before: all frames before players and the joint fit.
        uncertainty: covariance of `camera`.
        matches: players; None without.
        weights: weights of the terms.
        feed_offset: the clip's clock offset; None without people.
        pitch: the pitch and the noise that the fit shows.
        searched: (n, 3) as of `follow_lines`.
    """

    camera: MovingCamera
    before: MovingCamera
    uncertainty: Uncertainty
    points: PointEvidence
    matches: Matches | None
    weights: Weights
    feed_offset: FeedOffset | None
    pitch: PitchFit
    searched: Integers


def report_calibration(
    tracked: TrackedClip,
    fit: JointFit,
    pitch: PitchTemplate,
    settings: BroadcastCalibrationSettings,
    first: int,
) -> BroadcastReport:
    """Return the report of a calibrated clip."""
    camera, points, keys, links = fit.camera, fit.points, tracked.keys, tracked.chain
    frames = len(camera)
    off, across = _residuals(camera, points)
    lines, players = points.kind == MARKING, points.kind == PLAYER
    agree = across < points.loss
    line_count = np.bincount(points.frame[lines & agree], minlength=frames)
    player_count = np.zeros(frames, dtype=np.int64)
    if fit.matches is not None:
        player_count = np.bincount(fit.matches.frame, minlength=frames)
    flow_count = np.bincount(tracked.flow.frame, minlength=frames)
    expected = expected_errors(camera, fit.uncertainty, pitch)
    status = _frame_status(tracked, line_count, player_count)
    earlier, later = median_residuals(fit.before, points), median_residuals(camera, points)
    contradicted = _find_contradicted(fit.searched, status)
    expected[contradicted] = np.nan
    reasons = _review_reasons(expected, status, keys, fit.pitch, settings, first)
    if contradicted.any():
        reasons.append(f"{contradicted.sum()} frames lack markings that other frames show")
    decisions = [
        f"a followed point counts {fit.weights.flow_share:.2g} of its loss, as tracking drifts",
        f"errors of a person last {fit.weights.player_frames:.1f} frames",
        *fit.pitch.describe,
    ]
    if fit.feed_offset is not None:
        clock, late = _describe_offset(fit.feed_offset, settings)
        decisions += [] if late else [clock]
        reasons += [clock] if late else []
    return BroadcastReport(
        status=status,
        reprojection_error=expected,
        marking_rms=_rms(off, points, lines & agree, frames),
        player_rms=_rms(off, points, players & agree, frames),
        marking_count=line_count,
        player_count=player_count,
        flow_count=flow_count,
        key_frames=keys.frames,
        refused=keys.refused,
        wrong=keys.wrong,
        contradicted=contradicted,
        drift=links.drift,
        feed_offset=fit.feed_offset,
        weights=fit.weights,
        pitch=fit.pitch,
        pick_next=_select_picks(expected),
        markings_off=(earlier[0], later[0]),
        players_off=(earlier[1], later[1]),
        decisions=tuple(decisions),
        reasons=tuple(reasons),
    )


def _frame_status(tracked: TrackedClip, line_count: Integers, player_count: Integers) -> Image:
    """Return the main evidence of each frame (frames,), an index into `FRAME_STATUS`."""
    status = np.full(len(line_count), FRAME_STATUS.index("bridged"), dtype=np.uint8)
    determined = tracked.chain.determined
    linked = np.append(determined, False) | np.append(False, determined)
    status[linked] = FRAME_STATUS.index("followed")
    status[player_count >= 3] = FRAME_STATUS.index("players")
    status[line_count >= 30] = FRAME_STATUS.index("lines")
    status[tracked.keys.frames] = FRAME_STATUS.index("key_frame")
    return status


def _find_contradicted(searched: Integers, status: Image) -> Flags:
    """Return the frames (frames,) that lack markings that other frames show.

    Paint is absent, worn or hidden in many honest clips: only markings count that key frames, and
    frames with most of their markings, show. Of these, a wrong camera meets up to a seventh by
    chance in simulated clips; healthy clips, real ones as well, meet nine tenths.
    """
    frame, marking, found = searched.T

    def share(of: Integers, chosen: Flags) -> tuple[Integers, Floats]:
        many = np.bincount(of[chosen], minlength=of.max(initial=0) + 1)
        met = np.bincount(of[chosen], found[chosen], minlength=len(many))
        return many, met / np.maximum(many, 1)

    is_key = status == FRAME_STATUS.index("key_frame")
    _, shown = share(frame, found >= 0)
    _, known = share(marking, (shown > 0.5)[frame] | is_key[frame])
    many, met = share(frame, (known > 0.5)[marking])
    bridged = status == FRAME_STATUS.index("bridged")
    few = np.zeros(len(status), dtype=np.bool_)
    few[: len(many)] = (many >= 60) & (met < 0.25)
    return np.asarray(few & ~is_key & ~bridged)


def _review_reasons(
    expected: Floats,
    status: Image,
    keys: Keys,
    pitch: PitchFit,
    settings: BroadcastCalibrationSettings,
    first: int,
) -> list[str]:
    """Return why a person must review the clip, apart from its clock."""
    reasons = []
    share = float(np.mean(expected > settings.weak_error_px))
    if share > 0.05:
        reasons.append(
            f"{100.0 * share:.0f} % of the frames expect errors over {settings.weak_error_px:g} px"
        )
    bridged = int((status == FRAME_STATUS.index("bridged")).sum())
    if bridged:
        reasons.append(f"{bridged} frames have no evidence and follow their neighbours")
    # No painter errs by 0.1 m.
    if pitch.paint_m > 0.1:
        reasons.append(
            f"markings differ from the rules by {pitch.paint_m:.2f} m per axis: the pitch has "
            "another size, or clicks have wrong names"
        )
    for frame, why in keys.refused.items():
        reasons.append(f"key frame {first + frame} is not used: {why}")
    for frame, names in keys.wrong.items():
        reasons.append(f"key frame {first + frame} does not rest on {', '.join(names)}")
    return reasons


def expected_errors(camera: MovingCamera, uncertainty: Uncertainty, pitch: PitchTemplate) -> Floats:
    """Return the expected image error of places on the pitch per frame (frames,) [px].

    Each error is the root mean square over the visible places; NaN if the frame shows none.
    """
    half = 0.5 * np.array([pitch.length, pitch.width])
    x, y = np.meshgrid(*(np.arange(-h, h + 1e-9, 4.0) for h in half))
    places = np.stack([x.ravel(), y.ravel(), pitch.height(x.ravel(), y.ravel())], axis=-1)
    expected = np.full(len(camera), np.nan)
    width, height = camera.image_size
    seen = camera.camera.project(places)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((seen >= 0.0) & (seen <= [width - 1.0, height - 1.0])).all(axis=-1))
    for frame in np.flatnonzero(inside.any(axis=1)):
        # A dozen places suffice for a frame's mean.
        chosen = np.flatnonzero(inside[frame])
        some = places[chosen[:: max(1, len(chosen) // 12)]]
        _, rows = camera.project_with_jacobian(int(frame), some)
        variance = np.einsum("nkp,pq,nkq->n", rows, uncertainty.frame[frame], rows)
        expected[frame] = np.sqrt(variance.mean())
    return expected


def _describe_offset(
    offset: FeedOffset, settings: BroadcastCalibrationSettings
) -> tuple[str, bool]:
    """Return a sentence on the clip's clock offset, and whether a person must review it."""
    if not offset.determined:
        return "the motion of people does not determine the clock offset of the feed", False
    sentence = (
        f"the clip shows people as they are {abs(offset.frames):.2f} frames "
        f"{'later' if offset.frames > 0.0 else 'earlier'} in the static cameras, with a standard "
        f"error of {offset.standard_error:.2f} frames"
    )
    if settings.feed_offset == "correct":
        return f"{sentence}: corrected", False
    beyond = abs(offset.frames) - 2.0 * offset.standard_error > 0.5
    todo = (
        f": lower the clip's broadcast_offset_frames by {offset.frames * offset.rate:.2f}, or set "
        "broadcast_calibration.feed_offset=correct"
    )
    return sentence + (todo if beyond else ""), beyond


def _residuals(camera: MovingCamera, points: PointEvidence) -> tuple[Floats, Floats]:
    """Return residuals (n,) in pixels (lines: across them) and in standard deviations (n,)."""
    off = np.clip(pixel_residuals(camera, points), -1e6, 1e6)
    white = np.linalg.norm(np.einsum("nij,nj->ni", points.whitening, off), axis=-1)
    scale = np.linalg.norm(points.whitening[:, 0], axis=-1)
    return white / np.maximum(scale, 1e-12), white


def _rms(off: Floats, points: PointEvidence, chosen: Flags, frames: int) -> Floats:
    count = np.bincount(points.frame[chosen], minlength=frames)
    total = np.bincount(points.frame[chosen], off[chosen] ** 2, minlength=frames)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _select_picks(expected: Floats) -> tuple[int, ...]:
    """Return the frames of largest expected error, at a distance from one another."""
    most = 5
    left = np.where(np.isfinite(expected), expected, -1.0)
    apart = max(1, len(expected) // (2 * most))
    picks: list[int] = []
    while len(picks) < most and left.max() > 0.0:
        best = int(left.argmax())
        picks.append(best)
        left[max(0, best - apart) : best + apart + 1] = -1.0
    return tuple(picks)


def median_residuals(camera: MovingCamera, points: PointEvidence) -> tuple[float, float]:
    """Return the median residuals of markings and of people [px]; NaN without any.

    Residuals of painted lines are distances across them, of inliers. Residuals of people are means
    over a person's keypoints per frame, which average out keypoint errors but not camera errors.
    """
    off = pixel_residuals(camera, points)
    lines = points.kind == MARKING
    with np.errstate(invalid="ignore"):
        white = np.abs(np.einsum("nj,nj->n", points.whitening[lines, 0], off[lines]))
    across = white / np.linalg.norm(points.whitening[lines, 0], axis=-1)
    across = across[white < points.loss[lines]]
    people = np.flatnonzero((points.kind == PLAYER) & np.isfinite(off).all(axis=-1))
    # Keypoints with gross errors say nothing about the camera.
    far = np.linalg.norm(off[people] * points.whitening[people][:, [0, 1], [0, 1]], axis=-1)
    people = people[far < 2.0 * points.loss[people]]
    key = np.column_stack([points.frame[people], points.source[people]])
    _, person, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(person.ravel(), off[people, axis]) for axis in range(2)], axis=-1)
    distances = np.linalg.norm(sums[: len(count)] / count[:, None], axis=-1)
    return (
        float(np.median(across)) if len(across) else float("nan"),
        float(np.median(distances)) if len(distances) else float("nan"),
    )


@dataclass(frozen=True, eq=False)
class BroadcastCalibration:
    """A moving camera, its covariance and its report: residuals, drift, frames to click next.

    Attributes:
        tracked: camera from key frames and followed points alone, before any refinement.
        before: `tracked` with rotation and focal length of each frame corrected on its painted
            lines, before players and the joint fit.
    """

    camera: MovingCamera
    uncertainty: Uncertainty
    report: BroadcastReport
    tracked: MovingCamera
    before: MovingCamera


def broadcast_arrays(calibration: BroadcastCalibration) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a calibrated clip, by name, without the frame numbers."""
    report, before = calibration.report, camera_arrays(calibration.before.camera)
    del before["image_size"], before["lens_model"]
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
    clip_id: str, calibration: BroadcastCalibration, first: int = 0, rate: float = 1.0
) -> dict[str, Any]:
    """Return the stored attributes of a calibrated clip, with frame numbers of its video.

    The video's number of the first frame is `first`, its frames per match frame are `rate`.
    """
    report, offset = calibration.report, calibration.report.feed_offset
    keys = report.pitch.keys
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
        "pitch": None if keys is None else {**keys, "std_m": report.pitch.size_std.tolist()},
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
