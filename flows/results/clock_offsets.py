"""Clock offsets of a match's static cameras, found from the people whom they see."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import ClipSpec, ClockOffset, MatchSpec
from flows.results.run_cameras import static_cameras
from flows.stage import Match
from flows.stages.detection import seen_by, seen_by_cameras
from worldpose.errors import InputError, unknown_name
from worldpose.geometry.cameras import Camera
from worldpose.ingest.clock import exact_frames, offset_change, remaining_offset, simplest_offset
from worldpose.ingest.footage import UnitFrames, unit_frames
from worldpose.pitch.template import PitchTemplate
from worldpose.store.store import Run

if TYPE_CHECKING:
    from worldpose.triangulation.clock_courses import Course
    from worldpose.triangulation.synchronization import Synchronization

MIN_OFFSET_FRAMES = 0.1
"""Remaining offset that is worth a correction [frame]."""


class Proposal(NamedTuple):
    """The clock offset of a camera, as stated and as found."""

    camera: str
    stated: ClockOffset
    """`offset_frames` in match.yaml [frame]."""
    found: float | None
    """The same with its fraction at the clip's start, by the people [frame]; None where they do not
    tell it."""
    std: float | None
    """Standard deviation [frame]."""
    proposed: ClockOffset
    """The offset for match.yaml [frame]: whole, or pairs where it changes within the clip."""
    reason: str
    """Why it is not known; empty where it is."""
    relative_to: str | None = None
    """The camera of its group whose offset stays; None where it is not known."""


class ClockOffsets(NamedTuple):
    """The clock offsets of a clip's static cameras."""

    clip: str
    names: list[str]
    """The compared cameras."""
    found: Synchronization
    rows: list[Proposal]

    @property
    def changed(self) -> dict[str, ClockOffset]:
        """The proposed offsets that differ from match.yaml, by camera [frame]."""
        return {row.camera: row.proposed for row in self.rows if row.proposed != row.stated}

    @property
    def verdict(self) -> str:
        """Which of the offsets that stay the people confirm, and which they do not tell."""
        stay = [row for row in self.rows if row.proposed == row.stated]
        # The offset of a reference stays whatever it is.
        told = [row for row in stay if row.found is not None and row.camera != row.relative_to]
        untold = [row.camera for row in stay if row.found is None]
        said = []
        if told and not self.has_rest:
            names = ", ".join(row.camera for row in told)
            to = " and ".join(dict.fromkeys(row.relative_to or "" for row in told))
            said.append(f"The people confirm the offsets of {names}, relative to {to}.")
        if untold:
            rest = f"Nothing tells the offsets of {', '.join(untold)}: they stay, right or wrong."
            said.append(rest)
        return " ".join(said)

    @property
    def warning(self) -> str:
        """A sentence about cameras that cannot be compared; empty if all can."""
        apart = [", ".join(self.names[c] for c in group) for group in self.found.groups]
        if len(apart) < 2:
            return ""
        return (
            f"{len(apart)} groups of cameras share no person: {'; '.join(apart)}. Offsets are "
            "relative to one camera of each group; those between groups are unknown."
        )

    @property
    def has_rest(self) -> bool:
        """Whether a fraction of a frame remains that `correct_clocks` corrects."""
        return any(
            row.found is not None
            and row.std is not None
            and not isinstance(row.proposed, tuple)
            and abs(row.found - row.proposed) > max(MIN_OFFSET_FRAMES, 3.0 * row.std)
            for row in self.rows
        )


def find_offsets(run: Run, match: Match, clip: str | None, max_offset_s: float) -> ClockOffsets:
    """Find the clock offsets of static cameras in a clip, or else in the longest.

    The cameras of the run are calibrated, and it has 2D poses; `max_offset_s` is the largest offset
    between two cameras [s]. InputError if fewer than two cameras have a calibration and 2D poses,
    UsageError if the match has no such clip.
    """
    spec, pitch = match.folder.spec, match.folder.pitch
    clip = choose_clip(spec, clip)
    known = static_cameras(run, spec)
    names = [
        camera.id
        for camera, unit in zip(spec.static_cameras, seen_by_cameras(match, clip), strict=True)
        if camera.id in known and unit in run
    ]
    if len(names) < 2:
        raise InputError(
            f"{match.match_id}: static cameras",
            expected="two calibrated cameras with 2D poses",
            found=", ".join(names) or "none",
            todo="Calibrate the cameras first; worldpose status tells what is missing.",
        )
    cameras = Camera.stack([known[name] for name in names])
    detections = load_detections(run, match, clip, names)
    template = None if pitch is None else PitchTemplate.from_spec(pitch)
    found, courses = find_clocks(cameras, detections, spec.fps, max_offset_s, template)
    its = spec.clip(clip)
    rows = [propose(spec, its, names, courses, c, found) for c in range(len(names))]
    return ClockOffsets(clip, names, found, rows)


def find_clocks(
    cameras: Camera,
    detections: KeypointDetections,
    fps: float,
    max_offset_s: float,
    pitch: PitchTemplate | None,
) -> tuple[Synchronization, list[Course]]:
    """Return the constant offsets of all cameras, and their offsets over the clip."""
    from worldpose.triangulation.clock_courses import (
        add_slow_drifts,
        shift_by_courses,
        trace_clocks,
    )
    from worldpose.triangulation.synchronization import synchronize as estimate

    size = None if pitch is None else (pitch.length, pitch.width)
    found = estimate(cameras, detections, fps, max_offset_s=max_offset_s, pitch=pitch)
    courses: list[Course] = [[(0, float(late))] for late in found.late]
    for group in (np.array(each) for each in found.groups if len(each) > 2):
        arrays = {name: array[:, group] for name, array in detections.arrays().items()}
        some = detections.with_arrays(arrays, detections.frame)
        traced = trace_clocks(cameras[group], some, fps, found.late[group], pitch_size=size)
        for c, course in zip(group.tolist(), traced, strict=True):
            courses[c] = course
    courses = add_slow_drifts(
        courses, cameras, detections, fps, max_offset_s=max_offset_s, pitch=pitch
    )
    if np.isfinite(found.late).all() or len(courses) < 3:
        return found, courses
    # One clock that changes can hide the offsets of all others.
    traced = trace_clocks(cameras, detections, fps, np.nan_to_num(found.late), pitch_size=size)
    corrected, _ = shift_by_courses(detections, traced)
    again = estimate(cameras, corrected, fps, max_offset_s=max_offset_s, pitch=pitch)
    if np.isfinite(again.late).sum() <= np.isfinite(found.late).sum():
        return found, courses
    return again, [
        [(row, value + float(late)) for row, value in course]
        for course, late in zip(traced, again.late, strict=True)
    ]


def propose(
    spec: MatchSpec,
    clip: ClipSpec,
    names: list[str],
    courses: list[Course],
    c: int,
    found: Synchronization,
) -> Proposal:
    """Return the proposal for one camera.

    The first one of its group whose clock does not change keeps its offset, so that one drift is
    not made that of all others.
    """
    name = names[c]
    unit, stated = unit_frames(spec, name), spec.camera(name).offset_frames
    if not isinstance(stated, tuple):
        stated = int(stated)
    if not np.isfinite(found.late[c]):
        return Proposal(name, stated, None, None, stated, found.reasons[c])
    group = next(each for each in found.groups if c in each)
    first = next((each for each in group if len(courses[each]) == 1), group[0])
    reference = courses[first]
    pairs = unit.offset if isinstance(unit.offset, tuple) else ()
    changes = [row for course in (courses[c], reference) for row, _ in course if len(course) > 1]
    # Stated changes outside of the clip stay, with what is found at its nearer end.
    row = np.unique([frame - clip.first_frame for frame, _ in pairs] + changes or [0])
    late = np.interp(row, *np.array(courses[c]).T) - np.interp(row, *np.array(reference).T)
    late -= _rounding(unit, clip) - _rounding(unit_frames(spec, names[first]), clip)
    frame = (row + clip.first_frame).astype(np.int64)
    exact = exact_frames(frame, unit.offset) - frame + offset_change(late, unit.rate)
    is_known = isinstance(stated, tuple) and np.abs(late).max() < MIN_OFFSET_FRAMES
    proposed = stated if is_known else simplest_offset(frame, exact)
    start, std = np.interp(clip.first_frame, frame, exact), found.std[c] * unit.rate
    return Proposal(name, stated, float(start), float(std), proposed, "", names[first])


def _rounding(unit: UnitFrames, clip: ClipSpec) -> float:
    """Return how much later a clip's images are on average, as the nearest ones [match frame]."""
    frame = np.arange(clip.first_frame, clip.first_frame + clip.frame_count)
    return float(remaining_offset(frame, unit.offset, unit.rate).mean())


def choose_clip(spec: MatchSpec, clip: str | None) -> str:
    """Return the requested clip, or else the longest."""
    names = [each.id for each in spec.clips]
    if clip is not None and clip not in names:
        raise unknown_name(f"--clip {clip}", clip, names)
    return clip or max(spec.clips, key=lambda each: each.frame_count).id


def load_detections(run: Run, match: Match, clip: str, names: list[str]) -> KeypointDetections:
    """Return the detections (frames, cameras, detections) of some static cameras in a clip."""
    span = match.folder.spec.clip(clip)
    where = slice(span.first_frame, span.first_frame + span.frame_count - 1)
    frames = np.arange(span.first_frame, span.first_frame + span.frame_count)
    parts = []
    for name in names:
        unit = seen_by(match, name, clip)
        if unit not in run:
            raise InputError(
                f"{match.match_id}: {name}",
                expected="2D poses of the camera",
                found="none",
                todo="worldpose status tells what failed.",
            )
        found = KeypointDetections.from_arrays(run[unit].sel(frame=where))
        parts.append(found.reindex(frames))
    return KeypointDetections.stack(parts)
