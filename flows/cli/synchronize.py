"""Command synchronize: find the clock offsets of a match's cameras from the people in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import typer

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import ClipSpec, ClockOffset, MatchSpec
from flows.cli import console
from flows.cli.console import DEFAULT_PROJECT, JsonOption, MatchArgument, ProjectOption
from flows.cli.options import WorkersOption
from flows.registering import find_match
from flows.results.outputs import claim_file
from flows.results.run_cameras import static_cameras
from flows.run_record import alone_with
from flows.running import RunRequest, run_match
from flows.stage import Match
from flows.stages.detection import seen_by, seen_by_cameras
from worldpose.errors import InputError, unknown_name
from worldpose.geometry.cameras import Camera
from worldpose.ingest.clock import exact_frames, simplest_offset
from worldpose.ingest.footage import unit_frames
from worldpose.pitch.template import PitchTemplate
from worldpose.store.store import Run, Store

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


def synchronize(
    match: MatchArgument,
    clip: str | None = None,
    max_offset: Annotated[float, typer.Option(min=0.1, max=60.0)] = 2.0,
    plot: Path | None = None,
    apply: Annotated[bool, typer.Option("--apply")] = False,
    workers: WorkersOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Find the clock offsets of the static cameras from moving people, and propose offset_frames.

    The cameras must be calibrated, and nothing must be known of their clocks. The command computes
    the match up to the 2D poses first. The offset of the first camera that it can tell stays, and
    --apply writes the others. A clock that drifts or steps has pairs [match frame, offset].

    Example: worldpose synchronize matches/lab --plot clocks.svg --apply

    Options:
        clip: Clip whose people are compared; the longest by default.
        max_offset: Largest offset between two cameras [s].
        plot: Plot of the matches by offset to write: .svg, .pdf or .png.
        apply: Write the proposed offset_frames into match.yaml.
    """
    from worldpose.reports.drawing import draw_synchronization, require_plot

    if plot is not None:
        require_plot(plot)
    store = Store.open_or_new(project)
    with console.progress(verbose=False):
        opened = find_match(store, match)
        spec = opened.folder.spec
        chosen_clip = choose_clip(spec, clip)
        claim_file(plot, opened.match_id)
        run = compute_poses(store, opened, workers, RunRequest({}, until_stage="detection"))
    cameras, names, detections = load_clip(run, opened, chosen_clip)
    pitch = opened.folder.pitch
    template = None if pitch is None else PitchTemplate.from_spec(pitch)
    found, courses = _find_clocks(cameras, detections, spec.fps, max_offset, template)
    known = np.isfinite(found.late)
    clip_spec = spec.clip(chosen_clip)
    rows = [_propose(spec, clip_spec, names, courses, c, found) for c in range(len(names))]
    apart = [", ".join(names[c] for c in group) for group in found.groups]
    if plot is not None:
        draw_synchronization(found, names, plot)
    changed = {row.camera: row.proposed for row in rows if row.proposed != row.stated}
    if apply and changed:
        from worldpose.ingest.writing import write_offsets

        write_offsets(opened.folder.folder, changed)
    if as_json:
        console.print_json(
            {
                "clip": chosen_clip,
                "cameras": [row._asdict() for row in rows],
                "applied": changed if apply else {},
            }
        )
    else:
        _print(rows, changed, plot, applied=apply)
    if len(apart) > 1:
        console.line(
            f"warning: {len(apart)} groups of cameras share no person: {'; '.join(apart)}. Offsets "
            "are relative to the first camera of each group; those between groups are unknown.",
            to=console.errors,
        )
    raise typer.Exit(0 if known.all() and len(apart) == 1 else 4)


def _find_clocks(
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


def _propose(
    spec: MatchSpec,
    clip: ClipSpec,
    names: list[str],
    courses: list[Course],
    c: int,
    found: Synchronization,
) -> Proposal:
    """Return the proposal of a camera: the first one of its group keeps its offset."""
    name = names[c]
    unit, stated = unit_frames(spec, name), spec.camera(name).offset_frames
    if not isinstance(stated, tuple):
        stated = int(stated)
    if not np.isfinite(found.late[c]):
        return Proposal(name, stated, None, None, stated, found.reasons[c])
    first = next(group[0] for group in found.groups if c in group)
    reference = courses[first]
    pairs = unit.offset if isinstance(unit.offset, tuple) else ()
    inside = [frame - clip.first_frame for frame, _ in pairs]
    inside = [row for row in inside if 0 <= row < clip.frame_count]
    row = np.unique([row for row, _ in (*courses[c], *reference)] + inside)
    late = np.interp(row, *np.array(courses[c]).T) - np.interp(row, *np.array(reference).T)
    frame = (row + clip.first_frame).astype(np.int64)
    exact = exact_frames(frame, unit.offset) - frame - late
    is_known = isinstance(stated, tuple) and np.abs(late).max() < MIN_OFFSET_FRAMES
    proposed = stated if is_known else simplest_offset(frame, exact)
    return Proposal(name, stated, float(exact[0]), float(found.std[c]), proposed, "", names[first])


def choose_clip(spec: MatchSpec, clip: str | None) -> str:
    """Return the requested clip, or else the longest.

    Raises:
        UsageError: the match has no such clip.
    """
    names = [each.id for each in spec.clips]
    if clip is not None and clip not in names:
        raise unknown_name(f"--clip {clip}", clip, names)
    return clip or max(spec.clips, key=lambda each: each.frame_count).id


def compute_poses(store: Store, match: Match, workers: int | None, *parts: RunRequest) -> Run:
    """Compute parts of the method, up to the 2D poses, with the gates of the match's other runs.

    Raises:
        InputError: another process runs the match, or results must be reviewed first.
    """
    with alone_with(store, match.match_id):
        for part in parts:
            record = run_match(store, match, replace(part, workers=workers))
    if record.waiting and any(name.startswith("detection/") for name in record.blocked):
        raise InputError(
            f"{match.match_id}: 2D poses",
            expected="all results that they need",
            found=f"{len(record.waiting)} that wait for review",
            todo=f"Decide them first: worldpose review list {match.match_id}.",
        )
    return Run(store, record)


def load_clip(run: Run, match: Match, clip: str) -> tuple[Camera, list[str], KeypointDetections]:
    """Return the calibrated cameras, their names, and their detections in a clip.

    Raises:
        InputError: fewer than two cameras have a calibration and 2D poses.
    """
    spec = match.folder.spec
    known = static_cameras(run, spec)
    seen = [
        camera.id
        for camera, unit in zip(spec.static_cameras, seen_by_cameras(match, clip), strict=True)
        if camera.id in known and unit in run
    ]
    if len(seen) < 2:
        raise InputError(
            f"{match.match_id}: static cameras",
            expected="two calibrated cameras with 2D poses",
            found=", ".join(seen) or "none",
            todo="Calibrate the cameras first; worldpose status tells what is missing.",
        )
    cameras = Camera.stack([known[name] for name in seen])
    return cameras, seen, load_detections(run, match, clip, seen)


def load_detections(run: Run, match: Match, clip: str, names: list[str]) -> KeypointDetections:
    """Return the detections (frames, cameras, detections) of some static cameras in a clip.

    Raises:
        InputError: a camera has no 2D poses.
    """
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


def _offset_text(offset: ClockOffset) -> str:
    """Return an offset as in match.yaml."""
    pairs = [list(pair) for pair in offset] if isinstance(offset, tuple) else offset
    return str(pairs)


def _print(
    rows: list[Proposal], changed: Mapping[str, ClockOffset], plot: Path | None, *, applied: bool
) -> None:
    """Print a table of the offsets, and what to do with them."""
    shown = [
        (
            row.camera,
            _offset_text(row.stated),
            "-" if row.found is None else f"{round(row.found, 2) + 0.0:.2f}",  # never -0.00
            "-" if row.std is None else f"{row.std:.2f}",
            "-" if row.found is None else _offset_text(row.proposed),
            row.reason if row.relative_to is None else f"relative to {row.relative_to}",
        )
        for row in rows
    ]
    head = ("camera", ">offset_frames", ">by the people", ">standard deviation", ">proposed", "")
    console.print_table("clock offsets of the cameras", head, shown)
    if plot is not None:
        console.line(f"wrote {plot}")
    if not changed:
        console.line("match.yaml needs no change.")
    elif applied:
        console.line(f"wrote offset_frames of {', '.join(changed)} into match.yaml")
    else:
        console.line("Add --apply to write the proposed offsets into match.yaml.")
    if any(
        row.found is not None
        and row.std is not None
        and not isinstance(row.proposed, tuple)
        and abs(row.found - row.proposed) > max(MIN_OFFSET_FRAMES, 3.0 * row.std)
        for row in rows
    ):
        console.line(
            "The fraction of a frame remains; worldpose run --set "
            "triangulation.correct_clocks=true corrects it."
        )
