"""Results of a run in the browser: 3D view, report, overlay videos, and exports."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Annotated, Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException, Query
from fastapi.responses import FileResponse, Response

from data_contracts.records import Name
from data_contracts.release import EXPORT_FORMATS, EXPORT_PURPOSES
from flows.reports.cameras import health_picture
from flows.reports.clip_video import clip_view, write_clip_video
from flows.reports.report import write_report
from flows.reports.viewer import describe_video, viewer_clip
from flows.results.best_results import (
    Origin,
    clips_of,
    describe_later,
    find_clips,
    joint_tracks,
    open_results,
    tracked_people,
)
from flows.results.comparison import SubjectChange, compare_runs, paired_people
from flows.results.export import export
from flows.results.outputs import OWNERS
from flows.results.possible_exports import impossible_exports
from flows.results.tool_exports import image_views
from flows.review.identities import names_said
from flows.stage import Match
from flows.web.app_context import PageContext
from flows.web.browser_words import describe_error, in_browser
from flows.web.images import file_mark
from worldpose.errors import WorldposeError
from worldpose.formats.viewer_file import ViewerClip, encode_frames, encode_scene
from worldpose.store.runs import LATEST
from worldpose.store.store import Run, Store

BINARY: Final = "application/octet-stream"
CACHED_FILES: Final = 12
"""Files that are kept; the oldest is removed for a new one."""
REPORT_POLICY: Final = (
    "sandbox allow-scripts allow-modals; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; frame-ancestors 'none'"
)
"""The report carries its own scripts: the browser gives it no session and no requests."""


class DrawnFiles:
    """Files that were drawn on request, each once per run and what else it shows."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="worldpose-pages-")
        self._lock = Lock()  # one at a time: drawing needs memory for all images

    def get(self, run: Run, name: str, draw: Callable[[Path], object], shows: str) -> Path:
        """Return the file `name` of a run, drawn by `draw` if it is not there.

        `shows` is a text that changes with all else that the file shows.
        """
        given = f"{run.record.match_id} {run.record.run_id} {name} {shows}"
        unique = hashlib.sha256(given.encode()).hexdigest()
        file = Path(self._folder.name) / f"{unique}{Path(name).suffix}"
        with self._lock:
            if not file.is_file():
                kept = sorted(file.parent.iterdir(), key=lambda each: each.stat().st_mtime)
                for each in kept[: max(0, len(kept) - CACHED_FILES + 1)]:
                    each.unlink()
                with TemporaryDirectory(prefix="worldpose-draft-") as draft:
                    made = Path(draft) / name
                    draw(made)
                    shutil.move(made, file)
        return file

    def clip_video(self, store: Store, run: Run, match: Match, clip: str) -> FileResponse:
        """Return the response with the overlay video of a clip, or HTTPException 404."""
        if clip_view(run, match, clip) is None:
            raise HTTPException(404, "no video of this clip is at hand")
        file = self.get(
            run,
            f"{clip}.mp4",
            lambda file: write_clip_video(store, run, match, clip, file),
            f"{names_said(match)} {footage_mark(match)}",
        )
        return FileResponse(file, media_type="video/mp4")


class _Clips:
    """The clip that was shown last, in memory: the browser asks for it range by range."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._key: tuple[str, str, str] | None = None
        self._clip: ViewerClip | None = None

    def get(self, run: Run, match: Match, clip: str) -> ViewerClip:
        there = [*match.at_hand().folder.videos]
        key = (run.record.run_id, clip, f"{_people_said(match)} {there}")
        with self._lock:
            if self._clip is None or self._key != key:
                origin = Origin(run, match.registration)
                video = describe_video(run, match, clip)
                self._clip = viewer_clip(origin, clip, video)
                self._key = key
            return self._clip


def _people_said(match: Match) -> str:
    """Return a text that changes with a match's id, roster and names of people."""
    return f"{match.registration.model_dump_json()} {names_said(match)}"


def footage_mark(match: Match) -> str:
    """Return a text that changes with the videos and stills of a match that are at hand."""
    folder = match.at_hand().folder  # nothing while the folder is away
    files = (*folder.videos.values(), *folder.stills.values())
    return str([file_mark(file) for file in files if file.exists()])


def _player_names(match: Match, run: Run) -> dict[str, str]:
    """Return the names of people whom the roster knows, by the subject of their metrics."""
    roster = {player.id: player for player in match.folder.spec.roster}
    found = {}
    for clip in clips_of(run.record):
        for person, track in tracked_people(run, clip)[1].items():
            if track.name:
                player = roster.get(track.name)
                name = player.name if player is not None and player.name else track.name
                found[f"{clip}: person {person}"] = name
    return found


def why_without_joints(run: Run, clip: str) -> str | None:
    """Return why no person of a clip has joints in 3D; None if some person has."""
    if np.isfinite(joint_tracks(run, clip, definition="detector").joints).any():
        return None
    unit = f"tracking/{clip}"
    said = run.manifest(unit).warnings if unit in run else ()
    reason = " ".join(in_browser(each) for each in said)
    return reason or "No person of this clip is triangulated, and none has a fitted body."


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the results of a run; without `run_id`, the latest that has people."""
    router = APIRouter(prefix="/api/matches/{match_id}/results")
    files, shown = DrawnFiles(), _Clips()

    def open_asked(match_id: str, run_id: str) -> tuple[Match, Run]:
        match = context.stored_match(match_id)
        return match, open_results(context.store, match_id, run_id)

    def open_clip(match_id: str, clip: str, run_id: str) -> ViewerClip:
        match, run = open_asked(match_id, run_id)
        if clip not in clips_of(run.record):
            raise HTTPException(404, "the run has no such clip")
        return shown.get(run, match, clip)

    @router.get("")
    def results(match_id: str) -> dict[str, Any]:
        return _describe_results(context, *open_asked(match_id, LATEST))

    @router.get("/metrics")
    def metrics(match_id: str, run_id: Name = LATEST) -> dict[str, Any]:
        return _describe_metrics(context, *open_asked(match_id, run_id))

    @router.get("/scenes/{clip}")
    def scene(match_id: str, clip: str, run_id: Name = LATEST) -> Response:
        return Response(encode_scene(open_clip(match_id, clip, run_id)), media_type=BINARY)

    @router.get("/scenes/{clip}/frames")
    def frames(
        match_id: str,
        clip: str,
        first: Annotated[int, Query(ge=0)],
        count: Annotated[int, Query(ge=1, le=10_000)],
        run_id: Name = LATEST,
    ) -> Response:
        shown_clip = open_clip(match_id, clip, run_id)
        return Response(encode_frames(shown_clip, first, count), media_type=BINARY)

    @router.get("/scenes/{clip}/views/{camera}")
    def view(
        match_id: str, clip: str, camera: str, frame: int, run_id: Name = LATEST
    ) -> dict[str, Any]:
        shown_clip = open_clip(match_id, clip, run_id)
        match, run = open_asked(match_id, run_id)
        return {"people": _project(Origin(run, match.registration), shown_clip, camera, frame)}

    @router.get("/report")
    def report(match_id: str, run_id: Name = LATEST) -> FileResponse:
        match, run = open_asked(match_id, run_id)

        def draw(file: Path) -> None:
            run_id = run.record.run_id
            write_report(context.store, match, file, run_id=run_id, videos=False)

        truth = map(file_mark, sorted((match.folder.folder / "reference").glob("*")))
        given = [*match.folder.clicked, *match.folder.calibrations, *truth]
        shows = f"{_people_said(match)} {match.journal.tip} {given} {footage_mark(match)}"
        return FileResponse(
            files.get(run, "report.html", draw, shows),
            media_type="text/html; charset=utf-8",
            headers={"content-security-policy": REPORT_POLICY},
        )

    @router.get("/videos/{clip}")
    def video(match_id: str, clip: str, run_id: Name = LATEST) -> FileResponse:
        match, run = open_asked(match_id, run_id)
        if clip not in clips_of(run.record):
            raise HTTPException(404, "the run has no such clip")
        return files.clip_video(context.store, run, match, clip)

    @router.get("/health/{clip}")
    def health(match_id: str, clip: str) -> Response:
        match, run = open_asked(match_id, LATEST)
        pictures = health_picture(run, match, clip)
        if not pictures:
            raise HTTPException(404, "no cameras of such a clip place people together")
        return Response(pictures[0].png, media_type="image/png")

    @router.get("/exports/{form}")
    def export_zip(match_id: str, form: str, run_id: Name = LATEST) -> FileResponse:
        match, run = open_asked(match_id, run_id)
        if form not in EXPORT_FORMATS:
            raise HTTPException(404, f"no such format; there are {', '.join(EXPORT_FORMATS)}")

        def draw(file: Path) -> None:
            folder = file.with_suffix("")
            export(Origin(run, match.registration), [form], folder)
            (folder / OWNERS).unlink()  # of folders on a disk; a download has one export
            shutil.make_archive(str(folder), "zip", folder)

        name = f"{match.match_id}-{run.record.run_id}-{form}.zip"
        return FileResponse(
            files.get(run, f"{form}.zip", draw, _people_said(match)),
            media_type="application/zip",
            filename=name,
        )

    return router


def _project(origin: Origin, clip: ViewerClip, camera: str, frame: int) -> list[dict[str, Any]]:
    """Return the people in 3D where a camera's image of a match frame shows them.

    There is nobody in frames without results, and in a camera that the run does not use.
    """
    row = frame - int(clip.frames[0])
    if not 0 <= row < len(clip.frames):
        return []
    near = slice(max(0, row - 1), row + 2)
    views = image_views(origin, clip.clip, clip.frames[near], corrected=True)
    view = next((each for each in views if each.name == camera), None)
    if view is None:
        return []
    pixels = view.project(view.at_images(clip.joints[near]))[row - near.start]
    size = view.camera.image_size
    with np.errstate(invalid="ignore"):
        is_near = (np.abs(pixels - size / 2) < 2 * size).all(axis=-1)  # no number is too long
    return [
        {
            "person": each.person,
            "name": each.name,
            "keypoints": [
                np.round(xy, 1).tolist() if known else None
                for xy, known in zip(places, there, strict=True)
            ],
        }
        for each, places, there in zip(clip.people, pixels, is_near, strict=True)
        if there.any()
    ]


def _describe_results(context: PageContext, match: Match, run: Run) -> dict[str, Any]:
    """Return clips and export formats of a run, and what came after it."""
    record = run.record
    clips = find_clips(record)
    lacking = {clip: why_without_joints(run, clip) for clip in clips}
    impossible = impossible_exports(run, match.folder.spec)
    alone = {} if clips else {"worldpose": "cameras alone: the run has no people yet"}
    return {
        "run": record.run_id,
        "state": record.state,
        "later": describe_later(context.store, record),
        "formats": [form for form in EXPORT_FORMATS if form not in impossible],
        "impossible": impossible,
        "purposes": {**EXPORT_PURPOSES, **alone},
        "clips": [
            {"id": clip, "video": clip_view(run, match, clip), "without_joints": lacking[clip]}
            for clip in clips
        ],
    }


def describe_changes(changes: list[SubjectChange]) -> list[dict[str, Any]]:
    """Return the cameras, clips and players that changed, as JSON."""
    return [asdict(each) for each in changes if each.mark != "unchanged"]


def _name_as_after(
    changes: list[SubjectChange], paired: Mapping[tuple[str, str], str], before: str
) -> list[SubjectChange]:
    """Name players by their ids in the second run, which the metrics and names of a page have."""
    names = {
        f"{clip}: person {other[6:]}": f"{clip}: person {person[6:]}"
        for (clip, person), other in paired.items()
    }
    return [
        replace(
            each,
            name=f"{each.name} of run {before}"
            if each.mark == "only in A"
            else names.get(each.name, each.name),
        )
        if each.kind == "player"
        else each
        for each in changes
    ]


def _describe_metrics(context: PageContext, match: Match, run: Run) -> dict[str, Any]:
    """Return the metrics of a run, and their changes since the run before it."""
    record, parent = run.record, run.record.parent
    changes, problem = list[SubjectChange](), ""
    if parent is not None:
        try:
            before = context.store.run(match.match_id, parent)
            paired = paired_people(context.store, before, record)
            changes = _name_as_after(
                compare_runs(context.store, before, record, paired), paired, parent
            )
        except WorldposeError as error:  # its results may be garbage collected
            problem = f"Run {parent} cannot be compared: {describe_error(error)}"
    return {
        "metrics": [
            {
                "kind": each.kind,
                "name": each.name,
                "values": {one.figure: one.after for one in each.figures},
            }
            for each in compare_runs(context.store, record, record)
        ],
        "names": _player_names(match, run),
        "before": parent,
        "problem": problem,
        "changes": describe_changes(changes),
        "unchanged": sum(each.mark == "unchanged" for each in changes),
    }
