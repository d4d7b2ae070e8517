"""Report of a broadcast calibration: status, residuals and expected errors per frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from data_contracts.broadcast_calibration import FRAME_STATUS
from worldpose.broadcast_calibration.chain import Chain
from worldpose.broadcast_calibration.evidence import (
    MARKING,
    PLAYER,
    FlowEvidence,
    PointEvidence,
)
from worldpose.broadcast_calibration.feed_offset import FeedOffset
from worldpose.broadcast_calibration.fit import misses, pixels_off
from worldpose.broadcast_calibration.key_frames import Keys
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.players import Matches
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.uncertainty import Uncertainty
from worldpose.broadcast_calibration.weights import Weights
from worldpose.pitch import PitchTemplate

_FEW_LINES: Final = 30
"""Minimum line samples that determine a frame's camera [1]."""
_FEW_PLAYERS: Final = 3
"""Minimum players that determine a frame's camera [1]."""
_PICKS: Final = 5
"""Maximum number of proposed key frames."""
_LATE: Final = 0.5
"""Clock offset above which the report warns [frame]."""
_GRID: Final = 4.0
"""Grid spacing of places on the pitch for expected errors [m]."""


@dataclass(frozen=True, eq=False)
class BroadcastReport:
    """Accuracy of a clip's camera, its evidence and warnings.

    Attributes:
        status: (frames,) main evidence of each frame, an index into FRAME_STATUS.
        reprojection_error: (frames,) expected image error of places on the pitch, root mean square
            over the visible places [px].
        marking_rms: (frames,) of the samples of painted lines, across them [px]; NaN without any.
        player_rms: (frames,) of matched keypoints [px]; NaN without any.
        marking_count: (frames,) samples of painted lines.
        player_count: (frames,) matched players.
        flow_count: (frames,) followed points from the frame to the next.
        key_frames: used key frames.
        refused: unusable key frames and the reasons.
        wrong: outliers among a key frame's clicks and markings, by frame.
        drift: (gaps,) tracking error from one key frame to the next [px].
        feed_offset: the clip's clock offset, from people; None without people.
        weights: of the terms.
        pick_next: frames whose clicks would help most, the best first.
        markings_off: median distance of painted lines from their projection [px], before players
            and the joint fit, and after; NaN without any.
        players_off: the same of people, by the mean over a person's keypoints.
        decisions: choices and the metrics behind them.
        reasons: why a person must review the clip; empty if not necessary.
    """

    status: NDArray[np.uint8]
    reprojection_error: Floats
    marking_rms: Floats
    player_rms: Floats
    marking_count: Integers
    player_count: Integers
    flow_count: Integers
    key_frames: Integers
    refused: Mapping[int, str]
    wrong: Mapping[int, tuple[str, ...]]
    drift: Floats
    feed_offset: FeedOffset | None
    weights: Weights
    pick_next: tuple[int, ...]
    markings_off: tuple[float, float]
    players_off: tuple[float, float]
    decisions: tuple[str, ...]
    reasons: tuple[str, ...]


def report_of(
    camera: MovingCamera,
    before: MovingCamera,
    uncertainty: Uncertainty,
    points: PointEvidence,
    flow: FlowEvidence,
    keys: Keys,
    links: Chain,
    matches: Matches | None,
    weights: Weights,
    pitch: PitchTemplate,
    settings: BroadcastCalibrationSettings,
    offset: FeedOffset | None,
    first: int,
) -> BroadcastReport:
    """Return the report of a calibrated clip.

    Args:
        camera: all frames.
        before: all frames before players and the joint fit.
        uncertainty: covariance of `camera`.
        points: evidence of the fit.
        flow: followed points of the fit.
        keys: its key frames.
        links: the chain of tracked cameras.
        matches: players; None without.
        weights: of the terms.
        pitch: the template.
        settings: thresholds.
        offset: the clip's clock offset; None without people.
        first: number of the clip's first frame in its video, for messages.
    """
    frames = len(camera)
    off, across = _residuals(camera, points)
    lines, players = points.kind == MARKING, points.kind == PLAYER
    agree = across < points.loss
    line_count = np.bincount(points.frame[lines & agree], minlength=frames)
    player_count = np.zeros(frames, dtype=np.int64)
    if matches is not None:
        player_count = np.bincount(matches.frame, minlength=frames)
    flow_count = np.bincount(flow.frame, minlength=frames)
    expected = expected_errors(camera, uncertainty, pitch)
    status = np.full(frames, FRAME_STATUS.index("bridged"), dtype=np.uint8)
    linked = np.append(links.determined, False) | np.append(False, links.determined)
    status[linked] = FRAME_STATUS.index("followed")
    status[player_count >= _FEW_PLAYERS] = FRAME_STATUS.index("players")
    status[line_count >= _FEW_LINES] = FRAME_STATUS.index("lines")
    status[keys.frames] = FRAME_STATUS.index("key_frame")
    earlier, later = misses(before, points), misses(camera, points)
    reasons = []
    share = float(np.mean(expected > settings.weak_error))
    if share > 0.05:
        reasons.append(
            f"{100.0 * share:.0f} % of the frames expect errors over {settings.weak_error:g} px"
        )
    bridged = int((status == FRAME_STATUS.index("bridged")).sum())
    if bridged:
        reasons.append(f"{bridged} frames have no evidence and follow their neighbours")
    reasons += [
        f"key frame {first + frame} is not used: {why}" for frame, why in keys.refused.items()
    ]
    reasons += [
        f"key frame {first + frame} does not rest on {', '.join(names)}"
        for frame, names in keys.wrong.items()
    ]
    decisions = [
        f"a followed point counts {weights.flow_share:.2g} of its loss, as tracking drifts",
        f"errors of a person last {weights.player_frames:.1f} frames",
    ]
    if offset is not None:
        clock, late = _said_of(offset, settings)
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
        drift=links.drift,
        feed_offset=offset,
        weights=weights,
        pick_next=_picks(expected),
        markings_off=(earlier[0], later[0]),
        players_off=(earlier[1], later[1]),
        decisions=tuple(decisions),
        reasons=tuple(reasons),
    )


def expected_errors(camera: MovingCamera, uncertainty: Uncertainty, pitch: PitchTemplate) -> Floats:
    """Return the expected image error of places on the pitch per frame (frames,) [px].

    Root mean square over the visible places; NaN if the frame shows none.
    """
    half = 0.5 * np.array([pitch.length, pitch.width])
    x, y = np.meshgrid(*(np.arange(-h, h + 1e-9, _GRID) for h in half))
    places = np.stack([x.ravel(), y.ravel(), pitch.height(x.ravel(), y.ravel())], axis=-1)
    expected = np.full(len(camera), np.nan)
    pixel, rows = np.empty(2), np.empty((2, 12))
    width, height = camera.image_size
    seen = camera.camera.project(places)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((seen >= 0.0) & (seen <= [width - 1.0, height - 1.0])).all(axis=-1))
    for frame in np.flatnonzero(inside.any(axis=1)):
        total, count = 0.0, 0
        # A dozen places suffice for a frame's mean.
        chosen = np.flatnonzero(inside[frame])
        for place in places[chosen[:: max(1, len(chosen) // 12)]]:
            if point_row(
                camera.rotation[frame],
                camera.center,
                camera.principal_point,
                camera.focal[frame],
                camera.distortion[frame],
                place,
                pixel,
                rows,
            ):
                total += float(np.trace(rows @ uncertainty.frame[frame] @ rows.T))
                count += 1
        expected[frame] = np.sqrt(total / max(count, 1))
    return expected


def _said_of(offset: FeedOffset, settings: BroadcastCalibrationSettings) -> tuple[str, bool]:
    """Return a sentence on the clip's clock offset, and whether a person must review it."""
    if not offset.determined:
        return "the feed's offset in time cannot be told from how people move", False
    said = (
        f"the pictures show people as they are {abs(offset.frames):.2f} frames "
        f"{'later' if offset.frames > 0.0 else 'earlier'} in the static cameras, to "
        f"{offset.standard_error:.2f} frames"
    )
    if settings.feed_offset == "correct":
        return f"{said}: corrected", False
    beyond = abs(offset.frames) - 2.0 * offset.standard_error > _LATE
    todo = (
        f": lower the clip's broadcast_offset_frames by {offset.frames:.2f}, or set "
        "broadcast_calibration.feed_offset=correct"
    )
    return said + (todo if beyond else ""), beyond


def _residuals(camera: MovingCamera, points: PointEvidence) -> tuple[Floats, Floats]:
    """Return residuals (n,) in pixels (lines: across them) and in standard deviations (n,)."""
    off = np.clip(pixels_off(camera, points), -1e6, 1e6)
    white = np.linalg.norm(np.einsum("nij,nj->ni", points.whitening, off), axis=-1)
    scale = np.linalg.norm(points.whitening[:, 0], axis=-1)
    return white / np.maximum(scale, 1e-12), white


def _rms(off: Floats, points: PointEvidence, chosen: NDArray[np.bool_], frames: int) -> Floats:
    count = np.bincount(points.frame[chosen], minlength=frames)
    total = np.bincount(points.frame[chosen], off[chosen] ** 2, minlength=frames)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _picks(expected: Floats) -> tuple[int, ...]:
    """Return the frames of largest expected error, at a distance from one another."""
    left = np.where(np.isfinite(expected), expected, -1.0)
    apart = max(1, len(expected) // (2 * _PICKS))
    picks: list[int] = []
    while len(picks) < _PICKS and left.max() > 0.0:
        best = int(left.argmax())
        picks.append(best)
        left[max(0, best - apart) : best + apart + 1] = -1.0
    return tuple(picks)
