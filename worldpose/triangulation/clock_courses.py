"""Clock offsets of cameras over a clip: constants, drifts and steps, of all cameras together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.camera_changes import place_steps, sum_clip
from worldpose.triangulation.change_parts import Part, fit_parts, is_settled
from worldpose.triangulation.clocks import move_to_match_time
from worldpose.triangulation.lost_views import find_lost_views
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.synchronization import synchronize

Course = list[tuple[int, float]]
"""Clock offset of a camera: rising rows of a clip with values [frame], linear between them."""


def trace_clocks(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    late: Floats,
    *,
    pitch_size: tuple[float, float] | None = None,
) -> list[Course]:
    """Return the clock offset of each camera over a clip, with steps and drifts.

    People are tracked and triangulated with the clocks so far. Changes that the tracker cannot
    follow are added, or else the clearest of the others; then the steps and drifts of all cameras
    are fitted together, until there is none.

    There are at least three cameras (cameras,), and detections (frames, cameras, detections) before
    tracking, in memory. `late` (cameras,) is the constant offset to start from [frame],
    `pitch_size` the length and width of the pitch that people stand on [m]; None = not known.
    """
    frames, count = detections.score.shape[:2]
    # Clocks may be frames apart.
    loose = TriangulationSettings(max_deviation=10.0)
    parts = [Part(c, "constant", 0, (float(value),)) for c, value in enumerate(late)]
    for _ in range(2 * count + 6):
        shifted, rest = shift_by_courses(detections, _courses(parts, count, frames))
        tracks = track_people(cameras, shifted, fps, TrackingSettings(), pitch_size=pitch_size)
        if lost := find_lost_views(cameras, shifted, tracks.joints, fps, ("clock",)):
            parts.append(
                Part(lost[0].camera, "step", lost[0].row or 0, (float(lost[0].amount[4]),))
            )
            continue
        index = tracks.detection_index
        moved = move_to_match_time(np.asarray(shifted.keypoints, np.float64), index, rest)
        # More people cost time and tell little more.
        every = 1 + index.size // 300_000
        people = replace(shifted, keypoints=moved, detection_index=index[:, :, ::every])
        add_up = partial(sum_clip, cameras, people, fps, np.arange(frames), settings=loose)
        sums = replace(add_up(bins=(max(1, round(0.2 * fps)), 1)), are_clocks_asked=True)
        if not len(sums.rows):
            break
        fitted = fit_parts(sums, place_steps(parts, frames, round(fps), add_up), frames, ("clock",))
        if len(fitted) == len(parts) == count or is_settled(parts, fitted):
            break
        # A common offset changes no residual: most clocks keep theirs.
        common = np.median([fitted[c].size[0] - parts[c].size[0] for c in range(count)])
        parts = [
            replace(part, size=(part.size[0] - common * (part.shape == "constant"),))
            for part in fitted
        ]
    return _courses(parts, count, frames)


def add_slow_drifts(
    courses: Sequence[Course],
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    *,
    max_offset_s: float,
    pitch: PitchTemplate | None = None,
) -> list[Course]:
    """Return courses with drifts that both ends of a clip show, such as 29.97 beside 30.

    `trace_clocks` sees changes within a second; these are a frame in half a minute. Arguments are
    those of `worldpose.triangulation.synchronization.synchronize`.
    """
    # Least difference of the ends in standard deviations [1], and in frames; their length [s].
    min_score, min_frames, end_s = 5.0, 0.25, 30.0
    frames = detections.score.shape[0]
    span = min(frames // 2, round(end_s * fps))
    if span < 2:
        return list(courses)
    first, last = (
        synchronize(cameras, detections[rows], fps, max_offset_s=max_offset_s, pitch=pitch)
        for rows in (slice(0, span), slice(frames - span, frames))
    )
    begin, change = first.late.copy(), last.late - first.late
    limit = np.maximum(min_score * np.hypot(first.std, last.std), min_frames)
    for group in first.groups:
        # Each end has its own zero, the median of the cameras whose offset it knows.
        both = np.array([c for c in group if np.isfinite(change[c])], dtype=int)
        if len(both):
            change[both] -= np.median(change[both])
            steady = both[np.abs(change[both]) <= limit[both]]
            kept = [courses[c][0][1] - begin[c] for c in (steady if len(steady) else both)]
            begin[both] += np.median(kept)
    drifts = np.abs(change) > limit
    # The ends' offsets are those of their middles.
    before, after = (0.5 * (span - 1) + np.array([0.0, frames - span])).tolist()
    found = []
    for c, course in enumerate(courses):
        slope = float(change[c]) / (after - before)
        line = [(row, float(begin[c]) + slope * (row - before)) for row in (0, frames - 1)]
        found.append(line if drifts[c] and len(course) == 1 else course)
    return found


def shift_by_courses(
    detections: KeypointDetections, courses: Sequence[Course]
) -> tuple[KeypointDetections, Floats]:
    """Return the nearest frames on the common clock, and offsets left (frames, cameras) [frame]."""
    frames, count = detections.score.shape[:2]
    frame = np.arange(frames)
    course = np.stack([np.interp(frame, *np.array(each).T) for each in courses], axis=1)
    row = np.floor(frame[:, None] - course + 0.5).astype(np.int64)
    outside = (row < 0) | (row >= frames)
    row = np.clip(row, 0, frames - 1)
    arrays = {}
    for name, array in detections.arrays().items():
        arrays[name] = array[row, np.arange(count)].astype(np.float64)
        arrays[name][outside] = np.nan
    rest = row + course - frame[:, None]
    rest = np.where(np.abs(rest) < 1.0, rest, 0.0)
    return detections.with_arrays(arrays, frame), rest


def _courses(parts: Sequence[Part], cameras: int, frames: int) -> list[Course]:
    """Return the courses of all cameras."""
    courses: list[Course] = []
    for c in range(cameras):
        own = [part for part in parts if part.camera == c]
        rows = {row for part in own for row in part.knots(frames)}
        at = np.array(sorted(rows))
        values = np.sum([part.size[0] * part.share(at, frames) for part in own], axis=0)
        courses.append([(int(a), float(b)) for a, b in zip(at, values, strict=True)])
    return courses
