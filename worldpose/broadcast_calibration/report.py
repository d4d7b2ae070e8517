"""What a broadcast calibration says about itself, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

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

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_FEW_LINES: Final = 30
"""Fewer samples of lines do not hold a camera by themselves [1]."""
_FEW_PLAYERS: Final = 3
"""Fewer players do not [1]."""
_PICKS: Final = 5
"""Frames to pick next that are named."""
_LATE: Final = 0.5
"""A feed further beside the static cameras than this is said to be so [frame]."""
_GRID: Final = 4.0
"""Between places of the pitch whose expected error is looked at [m]."""


@dataclass(frozen=True, eq=False)
class BroadcastReport:
    """How well a clip's camera is known, and why.

    Attributes:
        status: (frames,) what each frame rests on, an index into FRAME_STATUS.
        reprojection_error: (frames,) expected error of places on the pitch in the picture, root
            mean square over what is seen [px].
        marking_rms: (frames,) of the samples of painted lines, across them [px]; NaN without any.
        player_rms: (frames,) of matched keypoints [px]; NaN without any.
        marking_count: (frames,) samples of painted lines.
        player_count: (frames,) matched players.
        flow_count: (frames,) followed points from the frame to the next.
        key_frames: those used.
        refused: those that could not be used, and why.
        wrong: clicks and markings that a key frame does not rest on, by frame.
        drift: (gaps,) by how much tracking from one key frame missed the next [px].
        feed_offset: the clip's clock, as people show it; None without people.
        weights: of the terms.
        pick_next: frames whose clicks would help most, the best first.
        markings_off: median distance of painted lines from their projection [px], before players
            and all frames together, and after; NaN without any.
        players_off: the same of people, by the mean over a person's keypoints.
        decisions: what was chosen, and the figures that decided.
        reasons: why a person must look at it; empty where nobody must.
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
    """Return what there is to say about a calibrated clip.

    Args:
        camera: all frames.
        before: the same before players and all frames together.
        uncertainty: its covariance.
        points: what it rests on.
        flow: followed points that it rests on.
        keys: its key frames.
        links: how it was tracked.
        matches: players; None without.
        weights: of the terms.
        pitch: the template.
        settings: thresholds.
        offset: the clip's clock; None without people.
        first: number of the clip's first picture in its video, for what is said in words.
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
    """Return the expected error of places on the pitch in each picture (frames,) [px].

    Root mean square over the places that the picture shows; NaN where it shows none.
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
        # A dozen places tell a frame's mean.
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
    """Return what the clip's clock is in words, and whether a person must look at it."""
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
    """Return residuals (n,) in pixels, those of lines across them, and in deviations (n,)."""
    off = np.clip(pixels_off(camera, points), -1e6, 1e6)
    white = np.linalg.norm(np.einsum("nij,nj->ni", points.whitening, off), axis=-1)
    scale = np.linalg.norm(points.whitening[:, 0], axis=-1)
    return white / np.maximum(scale, 1e-12), white


def _rms(off: Floats, points: PointEvidence, chosen: NDArray[np.bool_], frames: int) -> Floats:
    count = np.bincount(points.frame[chosen], minlength=frames)
    total = np.bincount(points.frame[chosen], off[chosen] ** 2, minlength=frames)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _picks(expected: Floats) -> tuple[int, ...]:
    """Return the frames that are known worst, apart from one another."""
    left = np.where(np.isfinite(expected), expected, -1.0)
    apart = max(1, len(expected) // (2 * _PICKS))
    picks: list[int] = []
    while len(picks) < _PICKS and left.max() > 0.0:
        best = int(left.argmax())
        picks.append(best)
        left[max(0, best - apart) : best + apart + 1] = -1.0
    return tuple(picks)
