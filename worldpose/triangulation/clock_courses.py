"""Clock offsets of cameras over a clip, with steps and drifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.changes import find_changes
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.camera_changes import (
    MeasuredChange,
    choose_change,
    explain_changes,
    measure_departures,
)
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

    People are tracked and triangulated with the clocks so far; changes that the tracker cannot
    follow are added, then the clearest of the others, until there is none.

    Args:
        cameras: batch (cameras,), at least three.
        detections: (frames, cameras, detections) in memory, before tracking.
        fps: frames per second [1/s].
        late: (cameras,) constant offset to start from [frame].
        pitch_size: length and width of the pitch that people stand on [m]; None = not known.
    """
    frames, count = detections.score.shape[:2]
    courses: list[Course] = [[(0, float(value))] for value in late]
    settings = TriangulationSettings()
    for _ in range(2 * count + 4):
        shifted, rest = shift_by_courses(detections, courses)
        tracks = track_people(cameras, shifted, fps, TrackingSettings(), pitch_size=pitch_size)
        if lost := find_lost_views(cameras, shifted, tracks.joints, fps, ("clock",)):
            c = lost[0].found.camera
            courses[c] = _add_change(courses[c], lost[0], frames)
            continue
        index = tracks.detection_index
        moved = move_to_match_time(np.asarray(shifted.keypoints, np.float64), index, rest)
        people = replace(shifted, keypoints=moved, detection_index=index)
        health = measure_departures(cameras, people, fps, settings, np.arange(frames))
        found = find_changes(health, fps, ("clock",))
        if not found:
            break
        change = explain_changes(cameras, people, fps, settings, found, ("clock",))
        if change is None or not change.is_explained:
            change = choose_change(cameras, people, fps, settings, found)
        if change is None or abs(change.amount[4]) < 0.1:
            break
        c = change.found.camera
        courses[c] = _add_change(courses[c], change, frames)
    return courses


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
    frames = len(detections.frame)
    span = min(frames // 2, round(end_s * fps))
    if span < 2:
        return list(courses)
    late, std, groups = [], [], []
    for rows in (slice(0, span), slice(frames - span, frames)):
        found = synchronize(cameras, detections[rows], fps, max_offset_s=max_offset_s, pitch=pitch)
        late.append(found.late)
        std.append(found.std)
        groups.append(found.groups)
    change = late[1] - late[0]
    for group in groups[0]:
        # Each end has its own zero, the median of the cameras whose offset it knows.
        both = [c for c in group if np.isfinite(change[c])]
        change[both] -= np.median(change[both]) if both else 0.0
    drifts = np.abs(change) > np.maximum(min_score * np.hypot(*std), min_frames)
    end = 0.5 * (frames - 1) / (frames - span) * change
    return [
        [(0, course[0][1] - float(end[c])), (frames - 1, course[0][1] + float(end[c]))]
        if drifts[c] and len(course) == 1
        else course
        for c, course in enumerate(courses)
    ]


def shift_by_courses(
    detections: KeypointDetections, courses: Sequence[Course]
) -> tuple[KeypointDetections, Floats]:
    """Return the nearest frames on the common clock, and what is left of the offsets [frame].

    Detections are (frames, cameras, detections), offsets that are left (frames, cameras).
    """
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


def _add_change(course: Course, change: MeasuredChange, frames: int) -> Course:
    """Return a course with a change, measured in rows of the common clock."""
    amount, row = float(change.amount[4]), change.found.row
    course = [(a, b + change.before) for a, b in course]
    at, there = np.array(course).T
    if not change.found.is_sudden:
        rows = np.unique([*at, 0, frames - 1])
        values = np.interp(rows, at, there) + amount * rows / max(1, frames - 1)
        return [(int(a), float(b)) for a, b in zip(rows, values, strict=True)]
    before = [(int(a), float(b)) for a, b in course if a < row - 1]
    after = [(int(a), float(b) + amount) for a, b in course if a > row]
    ends = np.interp([row - 1, row], at, there)
    return [*before, (row - 1, float(ends[0])), (row, float(ends[1]) + amount), *after]
