"""HTML report of a run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from data_contracts.conventions import COCO17_HIPS
from data_contracts.evaluation import Evaluation
from data_contracts.release import DataSetStatistics
from data_contracts.review import (
    Correction,
    MovedPoint,
    RedrawnMarking,
    ReviewDecision,
    ReviewRequest,
    Withdrawal,
)
from flows.reports.cameras import camera_pictures, camera_table, health_picture, paint_pictures
from flows.reports.clip_video import static_view, write_clip_video
from flows.reports.clips import clip_pictures, detection_pictures, disagreement_pictures
from flows.reports.people import adjustment_tables, body_tables, people_tables
from flows.reports.viewer import report_viewer
from flows.results.best_results import (
    clip_positions,
    clips_of,
    find_clips,
    joint_tracks,
    open_results,
)
from flows.results.evaluation import reference_side, score
from flows.results.run_cameras import BROADCAST, broadcast_cameras, broadcast_views, static_cameras
from flows.review.descriptions import in_words, is_first_click, when
from flows.stage import Match
from worldpose.dataset.statistics import clip_statistics, data_set_statistics, kind_of, most_moving
from worldpose.errors import UsageError, WorldposeError
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.reports.data_set import counted_section
from worldpose.reports.drawing import keep_figures, write_figure
from worldpose.reports.html_page import CaptionedImage, Failure, LinkedFile, Section, Table
from worldpose.reports.run_report import report_page
from worldpose.store.store import Run, Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURE_NAME: Final = 60
"""Maximum length of the words in a figure's file name [characters]."""


def write_report(
    store: Store,
    match: Match,
    out: Path,
    *,
    run_id: str = "latest",
    reference: str | None = None,
    videos: bool = True,
    camera: str | None = None,
    figures: Path | None = None,
) -> tuple[list[Path], str]:
    """Write the HTML report of one run.

    The reference is ground truth; None = `reference/` of the match folder, if it exists. Videos are
    each clip's broadcast video, and that of a static camera (None = the one with most people), with
    the results overlaid. `figures` is a folder for the page's figures as SVG, PDF and JSON.
    Returned are the videos written next to it; and why a reference is not scored, empty if it is.
    """
    if out.is_dir():
        todo = f"Name a file in it, as in --out {out / 'report.html'}."
        raise UsageError(f"--out {out}", expected="a file", found="a folder", todo=todo)
    match = match.at_hand()
    if camera is not None:
        _check_film(match, camera)
    run = open_results(store, match.match_id, run_id)
    if not any(unit.startswith(("static_calibration/", BROADCAST)) for unit in run):
        clips_of(run.record)  # without cameras, there have to be people
    scores, truth, unscored = _against_truth(store, run, match, reference)
    # What two threads would import late. Modules of large libraries import each other in a circle,
    # and a thread that enters it elsewhere than the other gets a module without its names.
    import_module("worldpose.store.groups")
    if broadcast_views(run):
        import_module("flows.reports.broadcast")
    with ThreadPoolExecutor(1) as painter:
        # Painting and encoding leave the interpreter to the figures for much of their time.
        filming = painter.submit(_write_videos, store, run, match, out, camera) if videos else None
        try:
            with nullcontext(None) if figures is None else keep_figures() as kept:
                first, *others = _sections(store, run, match, truth)
        except BaseException:
            for film in [] if filming is None else filming.result():
                film.unlink()  # without its page, the next report would take it for another's
            raise
    films = [] if filming is None else filming.result()
    beside = [LinkedFile(film.stem.removeprefix(f"{out.stem}-"), film.name) for film in films]
    about = "With markings and people drawn over them, in the folder of this page."
    shown = Section("Videos", tuple(beside), about)
    if unscored:
        others.append(Section("Against the truth", (Table("", ("",), ((Failure(unscored),),)),)))
    if figures is not None and kept is not None:
        _write_figures([first, *others], kept, figures)
    page = report_page(
        match.match_id,
        run.record,
        seconds={name: run.manifest(name).seconds for name in run.record.results},
        scores=scores,
        sections=[first, shown, *others],
        tiles=tiles_of(run, match, scores),
    )
    with whole_file(out) as draft:
        draft.write_text(page, encoding="utf-8")
    return films, unscored


def _write_figures(sections: list[Section], kept: Mapping[bytes, Figure], folder: Path) -> None:
    """Write the figures of the sections, numbered in the order of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    shown = (
        (section.heading, block.caption, kept[block.png])
        for section in sections
        for block in section.blocks
        if isinstance(block, CaptionedImage) and block.png in kept
    )
    for number, (heading, caption, figure) in enumerate(shown, start=1):
        words = re.sub(r"[^a-z0-9]+", "-", f"{heading} {caption}".lower())
        stem = folder / f"{number:02d}-{words[:FIGURE_NAME].strip('-')}"
        write_figure(figure, stem, caption)


def _check_film(match: Match, camera: str) -> None:
    names = {each.id for each in match.folder.spec.static_cameras} & set(match.folder.videos)
    if camera not in names:
        raise UsageError(
            f"--camera {camera}",
            expected="a static camera that has a video",
            found=f"these have one: {', '.join(sorted(names)) or 'none'}",
            todo="Name one of them, or omit --camera.",
        )


def _write_videos(
    store: Store, run: Run, match: Match, out: Path, camera: str | None
) -> list[Path]:
    films = []
    for view in (it for it in broadcast_views(run) if it in match.folder.videos):
        from flows.reports.broadcast import write_broadcast_video  # late: it imports estimators

        films.append(out.with_name(f"{out.stem}-{view}.mp4"))
        write_broadcast_video(run, match, view, films[-1])
    for clip in find_clips(run.record):
        owner = camera or static_view(run, match, clip)
        if owner is not None:
            films.append(out.with_name(f"{out.stem}-{clip}-{owner}.mp4"))
            with whole_file(films[-1]) as draft:
                write_clip_video(store, run, match, clip, draft, owner=owner)
    return films


def _sections(store: Store, run: Run, match: Match, truth: JointTracks | None) -> list[Section]:
    """Return all sections of the report, in the order of a reader's questions."""
    clips = find_clips(run.record)
    filmed = clips if match.has_static_cameras else ()
    cameras = static_cameras(run, match.folder.spec)
    viewer, left_out = report_viewer(run, match)
    extent = extent_of(run, match) if clips else None
    broadcast = list[CaptionedImage | Table]()
    if broadcast_views(run):  # late: it imports the estimators of a broadcast camera
        from flows.reports.broadcast import broadcast_pictures, broadcast_tables

        broadcast = [*broadcast_pictures(run, match), *broadcast_tables(run, match)]
    return [
        Section(
            "3D view",
            viewer,
            "Drag to rotate, Shift and drag to pan; click, then use the wheel or pinch to zoom. "
            f"Space plays.{left_out}",
        ),
        Section(
            "Sample images",
            tuple(p for clip in filmed for p in clip_pictures(store, run, match, clip, truth)),
        ),
        Section(
            "People",
            tuple(people_tables(run, clips, match.folder.spec.fps)),
            "Triangulated: joints and body in 3D. Plane: placed on the ground by the feet, where "
            "too few cameras see the person; a body of such a person comes from the poses of a "
            "monocular method. Mixed: both, in different frames.",
        ),
        *([counted_section(extent)] if extent and extent.poses else []),
        Section(
            "Detections",
            tuple(p for clip in filmed for p in detection_pictures(store, run, match, clip)),
            "Detections of one camera, and the people that all cameras together find.",
        ),
        Section(
            "Static cameras",
            (
                *([camera_table(run, match.folder.spec)] if match.has_static_cameras else []),
                *(p for clip in filmed for p in health_picture(run, match, clip)),
                *camera_pictures(store, run, match, cameras),
                *paint_pictures(store, run, match, cameras),
            ),
        ),
        Section("Bundle adjustment", tuple(adjustment_tables(run))),
        Section("Broadcast camera", tuple(broadcast)),
        Section(
            "Bodies",
            (
                *body_tables(run, clips),
                *(p for clip in filmed for p in disagreement_pictures(store, run, match, clip)),
            ),
        ),
        Section("Who reviewed what", tuple(review_table(match))),
    ]


def _against_truth(
    store: Store, run: Run, match: Match, reference: str | None
) -> tuple[Evaluation | None, JointTracks | None, str]:
    """Return scores, true joints, and why there are no scores in spite of a reference.

    A report does not fail for a reference of the match folder: nobody asked for it.
    """
    own, clips = match.folder.folder / "reference", find_clips(run.record)
    source = reference or (str(own) if (own / "joints.npz").is_file() else None)
    if source is None:
        return None, None, ""
    truth = None
    try:
        truth = reference_side(source).joints
        if len(clips) == 1:
            scores = score(match.match_id, source, store.url, run_id=run.record.run_id)
            return scores.evaluation, truth, ""
    except WorldposeError as error:
        if reference is not None:
            raise
        return None, truth, f"The results are not scored against {source}: {error}"
    if not clips and reference is None:
        return None, truth, ""
    found = f"the run has {len(clips)} clips with people, and a reference is of one"
    todo = " Export the match, and evaluate clip by clip." if clips else ""
    return None, truth, f"The results are not scored against {source}: {found}.{todo}"


def extent_of(run: Run, match: Match) -> DataSetStatistics:
    """Count clips, frames, poses and distances of a run; a person's position is the mid-hip."""
    clips = {}
    for clip in find_clips(run.record):
        places = joint_tracks(run, clip, definition="detector").joints[:, :, COCO17_HIPS].mean(2)
        moving = broadcast_cameras(run, clip).values()
        kinds = [kind_of(each.focal.mean(-1), each.cam_from_world.rotation) for each in moving]
        kind = most_moving(kinds) if kinds else "S"
        clips[clip] = clip_statistics(places, match.folder.spec.fps, kind)
    return data_set_statistics(clips)


def tiles_of(run: Run, match: Match, scores: Evaluation | None) -> list[tuple[str, str]]:
    """Return the key metrics for the top of the report."""
    static = (f"{len(match.folder.spec.static_cameras)}", "static cameras")
    if not find_clips(run.record):
        moving = broadcast_cameras(run).values()
        return [static, (f"{sum(len(each.focal) for each in moving):,}", "broadcast frames")]
    clips_with_feet = {}
    for clip in find_clips(run.record):  # also of people whom only their feet place
        xy = clip_positions(run, clip).xy
        places = np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=-1)
        clips_with_feet[clip] = clip_statistics(places, match.folder.spec.fps)
    found, placed = extent_of(run, match), data_set_statistics(clips_with_feet)
    in_3d, people = (sum(clip.persons for clip in each.clips.values()) for each in (found, placed))
    clips = "1 clip" if len(found.clips) == 1 else f"{len(found.clips)} clips"
    tiles = [
        (f"{60.0 * found.minutes:.1f} s", f"{found.frames:,} frames in {clips}"),
        (f"{people}", "people" if in_3d == people else f"people on the pitch, {in_3d} with joints"),
        (f"{found.poses:,}", "3D poses"),
        static,
        (f"{1000.0 * placed.distance_km:,.0f} m", "run and walked by all"),
    ]
    if scores is not None and scores.mpjpe_mm is not None and np.isfinite(scores.mpjpe_mm):
        tiles.append((f"{scores.mpjpe_mm:.0f} mm", "mean error of a joint, against the truth"))
    return tiles


MAX_ROWS = 200
"""Maximum number of rows, the last ones."""


def review_table(match: Match) -> list[Table]:
    """Tabulate verdicts, corrections and withdrawals, first to last; empty without any.

    The first clicks of a person in a camera are one row: they correct nothing.
    """
    units: dict[str, str] = {}
    clicked: dict[tuple[str, str], tuple[int, set[str]]] = {}
    corrections: dict[str, str] = {}
    rows: list[tuple[str, str, str, str, str]] = []
    for said in match.journal.records:
        if isinstance(said, ReviewRequest):
            units[said.id] = ", ".join(said.keys)
        elif isinstance(said, ReviewDecision):
            verdict = {"approve": "approved", "reject": "rejected"}[said.verdict]
            what = units.get(said.request, said.request)
            rows.append((when(said.decided_at), said.who, verdict, what, said.why or ""))
        elif isinstance(said, Correction):
            corrections[said.id] = in_words(said)
            if is_first_click(said):
                assert isinstance(said.edit, MovedPoint | RedrawnMarking)  # only these are clicks
                key = said.who, said.edit.camera
                row, names = clicked.setdefault(key, (len(rows), set()))
                names.add(said.edit.marking)
                count = "1 marking" if len(names) == 1 else f"{len(names)} markings"
                what = f"{count} in {said.edit.camera}"
                begun = rows[row][0] if row < len(rows) else when(said.made_at)
                rows[row : row + 1] = [(begun, said.who, "clicked", what, "")]
                continue
            rows.append(
                (when(said.made_at), said.who, "corrected", in_words(said), str(said.note or ""))
            )
        elif isinstance(said, Withdrawal):
            what = corrections.get(said.correction, said.correction)
            rows.append((when(said.withdrawn_at), said.who, "took back", what, said.why or ""))
    if not rows:
        return []
    left = len(rows) - MAX_ROWS
    heading = f"The last {MAX_ROWS}; {left} came before" if left > 0 else ""
    return [Table(heading, ("when", "who", "", "what", "why"), tuple(rows[-MAX_ROWS:]))]
