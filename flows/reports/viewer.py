"""What the 3D viewer shows of a run's clip, for the file and for the page of results."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.run import BODY_STAGES
from flows.reports.clip_video import clip_view, video_frames, write_clip_video
from flows.results.best_results import (
    Origin,
    bodies_unit,
    clip_positions,
    find_clips,
    fitted_bodies,
    person_kinds,
)
from flows.results.run_cameras import estimated_pitch, moving_cameras, static_cameras
from flows.results.tool_exports import describe_clip
from flows.stage import Match
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.errors import UsageError
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.tables import Positions
from worldpose.formats.viewer_file import ViewerClip, ViewerPerson, viewer_pieces, write_viewer
from worldpose.reports.html_page import EmbeddedPage
from worldpose.store.store import Run

REPORT_POSES: Final = 100_000
"""Maximum people times frames in a report's 3D view: about 30 MB of text."""


def report_viewer(run: Run, match: Match) -> tuple[tuple[EmbeddedPage, ...], str]:
    """Return the 3D view of a run's clips for its report, and what the view leaves out.

    The view has the clips in their order, until there are `REPORT_POSES` people times frames. There
    is no page if there is nobody to show, and the sentence is empty if all is shown.
    """
    origin, spare, clips, all_frames = Origin(run, match.registration), REPORT_POSES, [], 0
    for name in find_clips(run.record):
        clip = viewer_clip(origin, name, None)
        all_frames += len(clip.frames)
        shown = clip.first_frames(spare // max(1, len(clip.people)))
        if shown.has_people:
            clips.append(shown)
            spare -= len(shown.frames) * len(clip.people)
    if not clips:
        return (), ""
    frames = sum(len(clip.frames) for clip in clips)
    left_out = (
        ""
        if frames == all_frames
        else f" It shows the first {frames / origin.spec.fps:.1f} s of "
        f"{all_frames / origin.spec.fps:.1f} s; `worldpose export --format viewer` writes all."
    )
    html = "".join(viewer_pieces(_viewer_page(), clips, {}))
    return (EmbeddedPage("3D view of all people", html),), left_out


def _viewer_page() -> str:
    return (files("flows.reports") / "viewer.html").read_text(encoding="utf-8")


def write_viewers(origin: Origin, out: Path) -> list[Path]:
    """Write `viewer/<clip>.html`; or the file `out` with all clips, if its name ends with .html.

    UsageError if a video is asked for, and no camera of a clip has one; InputError if nobody is
    there.
    """
    page, (store, match) = _viewer_page(), origin.footage or (None, None)
    written: dict[Path, tuple[str, ...]] = {
        out / "viewer" / f"{clip}.html": (clip,) for clip in origin.clips
    }
    if out.suffix == ".html":
        written = {out: origin.clips}
    for path, names in written.items():
        with TemporaryDirectory(prefix="worldpose-viewer-") as draft:
            videos, clips = dict[str, Path](), []
            for name in names:
                video = None
                if store is not None and match is not None:
                    video = describe_video(origin.run, match, name)
                    if video is None:
                        raise UsageError(
                            "--video",
                            expected=f"a camera with a video that films clip {name}",
                            found="no video of any camera",
                            todo="Export without --video, or add the videos to the match's folder "
                            "videos/.",
                        )
                    videos[name] = Path(draft) / f"{name}.mp4"
                    write_clip_video(store, origin.run, match, name, videos[name])
                clips.append(viewer_clip(origin, name, video))
            write_viewer(path, page, clips, videos)
    return list(written)


def describe_video(run: Run, match: Match, clip: str) -> dict[str, Any] | None:
    """Return camera, first match frame, number of frames and step of a clip's overlay video."""
    owner = clip_view(run, match, clip)
    if owner is None:
        return None
    frames = video_frames(run, match, clip, owner)
    step = int(frames[1] - frames[0]) if len(frames) > 1 else 1
    return {"camera": owner, "first": int(frames[0]), "frames": len(frames), "step": step}


def viewer_clip(origin: Origin, clip: str, video: Mapping[str, Any] | None) -> ViewerClip:
    """Return a clip of a run as the viewer shows it, with its video as `describe_video` returns it.

    A `stage` before body fitting shows joints in place of bodies. The pitch has the surface that
    the run estimated.
    """
    # Imported here: it loads matplotlib's colours, which takes 0.5 s.
    from worldpose.reports.drawing import markings, note_undrawn_distortion, person_color

    shown = estimated_pitch(origin.run, origin.pitch, origin.spec, clip)
    tracks, positions = origin.tracks(clip), clip_positions(origin.run, clip)
    kinds = person_kinds(origin.run, clip)
    roster = {player.id: player for player in origin.spec.roster}
    people = []
    for person, name in zip(positions.person.tolist(), positions.names, strict=True):
        player = roster.get(name)
        people.append(
            ViewerPerson(
                person=person,
                name=name if player is None else player.name or name,
                kind=kinds[person],
                team="" if player is None else player.team,
                color=person_color(person),
            )
        )
    column = np.searchsorted(positions.person, tracks.person_ids)
    shape = (len(tracks.frames), len(people), 17)
    joints, spread = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    views = np.full(shape, -1, dtype=np.int64)
    joints[:, column] = tracks.joints
    if tracks.covariance is not None:
        variance = np.trace(tracks.covariance, axis1=-2, axis2=-1) / 3.0
        spread[:, column] = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    if tracks.views is not None:
        views[:, column] = tracks.views
    # x, y and standard deviation (frames, people, 3) [m] of people placed by their feet.
    variance = np.trace(positions.covariance, axis1=-2, axis2=-1) / 2.0
    error = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    ground = np.concatenate([positions.xy, error[..., None]], axis=-1)
    model, bodies = _bodies(origin, clip, tracks, positions)
    still = static_cameras(origin.run, origin.spec, origin.stage)
    notes = {"units": "metres, seconds"} | note_undrawn_distortion(still)
    return ViewerClip(
        clip=clip,
        fps=origin.spec.fps,
        frames=tracks.frames,
        people=tuple(people),
        joints=joints,
        spread=spread,
        views=views,
        ground=np.where(positions.on_plane[..., None], ground, np.nan),
        height=positions.height,
        bodies=bodies,
        model=model,
        cameras=still,
        moving=moving_cameras(origin.run, clip, tracks.frames, still),
        markings=[] if shown is None else markings(shown),
        notes=describe_clip(origin, clip) | notes,
        video=video,
    )


def _bodies(
    origin: Origin, clip: str, tracks: JointTracks, positions: Positions
) -> tuple[BodyModel | None, BodyParameters | None]:
    """Return body model and bodies (frames, people) in the frames of the joints."""
    unit = bodies_unit(origin.run, clip)
    if unit not in origin.run or origin.stage not in (None, *BODY_STAGES):
        return None, None
    model, poses, persons, own = fitted_bodies(origin.run, clip)
    _, rows, here = np.intersect1d(own, tracks.frames, return_indices=True)
    column = np.searchsorted(positions.person, persons)

    def place(values: Floats) -> Floats:
        placed = np.full((len(tracks.frames), len(positions.person), values.shape[-1]), np.nan)
        placed[here[:, None], column] = values[:, rows].swapaxes(0, 1)
        return placed

    names = ("betas", "global_orient", "body_pose", "transl")
    return model, BodyParameters(*(place(getattr(poses, name)) for name in names))
