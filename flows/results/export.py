"""Export formats of a run's results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.pin import Pin
from data_contracts.release import BaselineSettings, ReleasedClip, ReleaseManifest
from flows.results import best_results
from flows.results.outputs import RELEASE, VIEWER_SUFFIX, own_whole, write_whole
from flows.results.run_cameras import (
    broadcast_views,
    estimated_pitch,
    moving_cameras,
    view_changes,
    with_brown_lenses,
)
from flows.results.tool_exports import TOOL_EXPORTS, export_alphapose, export_coco, filmed_cameras
from worldpose.dataset import manifest as manifests
from worldpose.errors import InputError, UsageError, unknown_name
from worldpose.formats import challenge
from worldpose.formats.baselines.result import write_slahmr_cameras, write_tracks
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import write_joints, write_poses
from worldpose.formats.release_cameras import write_moving_camera, write_static_camera
from worldpose.formats.tables import write_positions
from worldpose.geometry.cameras import Camera
from worldpose.ingest.footage import image_clock, unit_frames
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.pitch.template import PitchTemplate
from worldpose.store.runs import pin_run, read_pin
from worldpose.store.store import Store
from worldpose.video.files import write_video

CAMERA_CHANGES = "camera_changes"
"""Folder of how static cameras' views change within each clip; cameras/ is from before."""
PITCH_SPACING = 0.5
"""Spacing of the points in pitch_points.txt [m]."""


def export_joints(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `joints.npz`, or `<clip>.joints.npz` per clip if there are several."""
    for clip in origin.clips:
        path = out / ("joints.npz" if len(origin.clips) == 1 else f"{clip}.joints.npz")
        write_joints(path, origin.tracks(clip))
        yield path


def export_worldpose(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `poses/<clip>.npz` and `cameras/<broadcast view or static camera>.npz`.

    A clip without people has cameras alone. A moving camera of another frame rate than the match is
    left out. Other lenses than Brown's are fitted by it; `lens_errors.json` states the errors of
    `fit_brown_lens`, and `camera_changes/<clip>.json` how static cameras change within a clip.
    InputError if a clip has people and no bodies, or Brown's model does not follow a lens.
    """
    with_people = best_results.find_clips(origin.run.record)
    rates = (unit_frames(origin.spec, view).rate for view in broadcast_views(origin.run))
    others = bool(with_people or origin.static_cameras) or 1.0 in rates
    # Before the first file: one lens that cannot be followed refuses the export.
    cameras, errors = with_brown_lenses(origin.static_cameras, "--format worldpose")
    for clip in best_results.all_clips(origin.run):
        if clip in with_people:
            model, poses, *_ = best_results.fitted_bodies(origin.run, clip)
            path = out / "poses" / f"{clip}.npz"
            write_poses(path, poses, model.name)
            yield path
        filmed = broadcast_views(origin.run, clip)
        moving = filmed_cameras(origin, clip, leave_out=others) if filmed else {}
        for view, camera in moving.items():
            path = out / "cameras" / f"{view}.npz"
            write_moving_camera(path, camera)
            yield path
        path = out / CAMERA_CHANGES / f"{clip}.json"  # without changes, too: it replaces others
        path.parent.mkdir(parents=True, exist_ok=True)
        told = [each.model_dump() for each in view_changes(origin.run, clip)]
        path.write_text(json.dumps(told, indent=1), encoding="utf-8")
        yield path
    for name, camera in cameras.items():
        path = out / "cameras" / f"{name}.npz"
        write_static_camera(path, camera.to_calibration(name))
        yield path
    if (stated := manifests.write_lens_errors(out, dict.fromkeys(cameras) | errors)) is not None:
        yield stated


def export_challenge(
    origin: best_results.Origin, out: Path, edition: challenge.Edition = 2026
) -> Iterator[Path]:
    """Write cameras, boxes, skeletons, pitch points and the submission, of each broadcast view."""
    filmed = _filmed(origin)
    together: dict[str, challenge.ChallengeClip] = {}
    submissions: dict[str, Floats] = {}
    filled: dict[str, dict[str, Any]] = {}
    for view, (clip, camera) in filmed.items():
        model, poses, *_ = best_results.fitted_bodies(origin.run, clip)
        truth = challenge.challenge_truth(model, poses, camera)
        submissions[view], told = _by_given_rows(origin, clip, truth)
        filled |= {view: told} if any(told.values()) else {}
        path = out / "cameras" / f"{view}.npz"
        error = challenge.write_challenge_camera(path, camera, edition)
        yield path
        # Below a tenth of a pixel the lens is that of the run for any use.
        lens = {view: None if error < 0.1 else {"max_error_px": error}}
        if (stated := manifests.write_lens_errors(out, lens)) is not None:
            yield stated
        if edition == 2025:
            together[view] = truth.clip
        else:
            yield from challenge.write_challenge(out, {view: truth.clip}, edition)
    if edition == 2025:
        yield from challenge.write_challenge(out, together, edition)
    if origin.pitch is not None:
        path = out / "pitch_points.txt"
        samples = PitchTemplate.from_spec(origin.pitch).sample_lines(PITCH_SPACING)
        challenge.write_pitch_points(path, samples.points_world)
        yield path
    path = out / "submission.zip"
    challenge.write_submission(path, submissions)
    yield path
    if filled:
        path = out / "filled_poses.json"
        path.write_text(json.dumps(filled, indent=1), encoding="utf-8")
        yield path


def _by_given_rows(
    origin: best_results.Origin, clip: str, truth: challenge.ChallengeTruth
) -> tuple[Floats, dict[str, Any]]:
    """Return a submission with the rows of given boxes, the gaps filled, and what was filled."""
    name, run = f"broadcast_tracking/{clip}", origin.run
    rows = run[name].attrs.get("given_people") if name in run else None
    if rows is None:
        return truth.submission, {}
    tracked, persons = run[name], best_results.fitted_bodies(run, clip)[2][truth.persons]
    joints = np.full((rows, *truth.submission.shape[1:]), np.nan)
    places = np.full((rows, joints.shape[1], 2), np.nan)
    joints[persons] = truth.submission
    places[tracked["person"].values] = tracked["ground"].values.swapaxes(0, 1)
    filled, added = challenge.fill_submission(joints, places)
    lacking = np.flatnonzero(np.isnan(filled.sum(axis=(-1, -2))).all(axis=1)).tolist()
    return filled, {"poses added": added, "rows without poses": lacking}


def _filmed(origin: best_results.Origin) -> dict[str, tuple[str, Camera]]:
    """Return the clip and the moving camera of every broadcast view.

    InputError if a clip has no fitted bodies or no such camera, or one of another frame rate.
    """
    found: dict[str, tuple[str, Camera]] = {}
    for clip in origin.clips:
        best_results.fitted_bodies(origin.run, clip)
        cameras = filmed_cameras(origin, clip)
        found |= {view: (clip, camera) for view, camera in cameras.items()}
    return found


def export_tracks(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `tracks/<view>.txt`, our boxes in the broadcast image, and the paper's settings."""
    yield _write_baseline_settings(out)
    for view, (clip, camera) in _filmed(origin).items():
        model, poses, persons, _ = best_results.fitted_bodies(origin.run, clip)
        truth = challenge.challenge_truth(model, poses, camera)
        path = out / "tracks" / f"{view}.txt"
        number = image_clock(origin.spec, view).number
        write_tracks(path, truth.clip.boxes, persons[truth.persons].astype(np.int64), number)
        yield path


def export_slahmr_cameras(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `slahmr/cameras/<view>/shot-0/cameras.npz`, and the paper's settings."""
    yield _write_baseline_settings(out)
    for clip in best_results.all_clips(origin.run) or origin.clips:
        for view, camera in filmed_cameras(origin, clip).items():
            path = out / "slahmr" / "cameras" / view / "shot-0" / "cameras.npz"
            write_slahmr_cameras(path, camera)
            yield path


def _write_baseline_settings(out: Path) -> Path:
    path = out / "baseline_settings.json"
    with whole_file(path) as draft:
        draft.write_text(BaselineSettings().model_dump_json(indent=2) + "\n", encoding="utf-8")
    return path


def export_recording(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `rerun/<clip>.rrd` for the rerun viewer."""
    # Imported here: it loads matplotlib's colours, which takes 0.5 s.
    from worldpose.reports.rerun_recording import write_recording

    for clip in origin.clips:
        tracks = origin.tracks(clip)
        moving = moving_cameras(origin.run, clip, tracks.frames, origin.static_cameras)
        path = out / "rerun" / f"{clip}.rrd"
        write_recording(
            path,
            tracks,
            origin.spec.fps,
            cameras=origin.static_cameras | moving,
            pitch=estimated_pitch(origin.run, origin.pitch, origin.spec, clip),
        )
        yield path


def export_positions(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `positions/<clip>.csv`: people on the pitch, triangulated or placed by their feet."""
    for clip in origin.clips:
        path = out / "positions" / f"{clip}.csv"
        write_positions(path, best_results.clip_positions(origin.run, clip), origin.spec.fps)
        yield path


def export_minimap(origin: best_results.Origin, out: Path) -> Iterator[Path]:
    """Write `minimap/<clip>.mp4`: the pitch from above with all people and their kind."""
    # Imported here: it loads matplotlib's colours, which takes 0.5 s.
    from worldpose.reports.videos import minimap_frames

    if origin.pitch is None:
        raise UsageError(
            "--format minimap",
            expected="a match with a pitch",
            found="a match without one",
            todo="Choose another format, such as joints.",
        )
    for clip in origin.clips:
        path = out / "minimap" / f"{clip}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        frames = minimap_frames(best_results.clip_positions(origin.run, clip), origin.pitch)
        write_video(path, frames, origin.spec.fps)
        yield path


def export_viewer(origin: best_results.Origin, out: Path) -> list[Path]:
    """Write `viewer/<clip>.html`, or one file with all clips where `out` ends with .html."""
    from flows.reports.viewer import write_viewers  # late: it loads matplotlib, which takes 0.5 s

    return write_viewers(origin, out)


EXPORTS: dict[str, Callable[[best_results.Origin, Path], Iterable[Path]]] = {
    "joints": export_joints,
    "coco": export_coco,
    "alphapose": export_alphapose,
    "worldpose": export_worldpose,
    "positions": export_positions,
    "minimap": export_minimap,
    **TOOL_EXPORTS,
    "viewer": export_viewer,
    "challenge": export_challenge,
    "challenge-2025": partial(export_challenge, edition=2025),
    "tracks": export_tracks,
    "slahmr-cameras": export_slahmr_cameras,
    "rerun": export_recording,
}
"""Name in `EXPORT_FORMATS` to function, which writes the source into a folder, file by file."""


OF_JOINTS = {"joints", "coco", "trc", "c3d", "csv", "parquet", "viewer", "rerun"}
"""Formats that have the joints of a chosen stage."""
POSITION_FORMATS = ("positions", "minimap", "csv", "parquet", "viewer")
"""Formats that hold people without joints, whom only their feet place on the pitch."""
OF_CAMERAS = ("worldpose", "slahmr-cameras")
"""Formats that hold cameras without people; the second one of broadcast cameras alone."""
CLASHING = {"worldpose", "challenge", "challenge-2025"}
"""Formats with the same file names; a folder can hold one of them."""
COUNTED = {"joints", *CLASHING}
"""Formats that `check` and `statistics` read, and that lack the frame rate."""


def export(
    origin: best_results.Origin, forms: list[str], out: Path, *, overwrite: bool = False
) -> list[Path]:
    """Write a run in several formats into one folder; return the files.

    Formats that `check` and `statistics` read also get frame_rates.json, and filled joints get
    origins/<clip>.npz, which flags them. Earlier files of the same match are replaced. `out` is a
    folder, or a file of the viewer. `overwrite` also replaces files of another match or of unknown
    origin.
    """
    if out.suffix == VIEWER_SUFFIX and set(forms) != {"viewer"}:
        raise _file_for_folder(out, forms)

    def write(place: Path) -> list[Path]:
        written = _export(origin, forms, place)
        for clip in origin.clips if origin.filled and out.suffix != VIEWER_SUFFIX else ():
            tracks = origin.tracks(clip)
            written.append(place / "origins" / f"{clip}.npz")
            manifests.write_origins(written[-1], tracks, manifests.origins_of(tracks))
        clips = best_results.all_clips(origin.run)
        if not clips or not COUNTED & set(forms):
            return written
        rates = dict.fromkeys(clips, origin.spec.fps)
        return [*written, manifests.write_frame_rates(place, rates)]

    match_id = origin.spec.match_id

    def claim(folder: Path, drafts: Mapping[str, Path]) -> None:
        own_whole(
            folder,
            drafts,
            best_results.all_clips(origin.run),
            (match_id,),
            overwrite=overwrite,
            cameras=origin.static_cameras,
        )

    return write_whole(out, write, claim)


def _file_for_folder(out: Path, forms: list[str]) -> UsageError:
    return UsageError(
        f"--out {out}",
        expected="a folder; a file only with --format viewer alone, and not for a release",
        found=f"the name of a file, with --format {' --format '.join(forms)}",
        todo="Give the name of a folder.",
    )


def require_formats(forms: list[str], stage: str | None) -> None:
    """Refuse formats that do not exist, that a stage does not have, or that clash."""
    for form in forms:
        if form not in EXPORTS:
            raise unknown_name(f"--format {form}", form, EXPORTS)
    if stage is not None and (others := sorted(set(forms) - OF_JOINTS)):
        raise UsageError(
            f"--stage {stage}",
            expected=f"formats of joints: {', '.join(sorted(OF_JOINTS))}",
            found=f"--format {' --format '.join(others)}, of the best results alone",
            todo="Export these formats without --stage.",
        )
    if len(clashing := CLASHING & set(forms)) > 1:
        raise UsageError(
            f"--format {' --format '.join(sorted(clashing))}",
            expected="formats with different file names",
            found="formats that all write cameras/<clip>.npz",
            todo="Export them into different folders.",
        )


def _export(origin: best_results.Origin, forms: list[str], out: Path) -> list[Path]:
    """Write formats like `export`, also for a release, whose manifest has the frame rate.

    If a broadcast camera alone films people, kinds.json tells that they are not triangulated.
    """
    require_formats(forms, origin.stage)
    of_people = [form for form in forms if form not in (*POSITION_FORMATS, *OF_CAMERAS)]
    # Other formats need a body, of which these joints are.
    of_bodies = partial(best_results.joint_tracks, origin.run)
    joints_of = origin.tracks if OF_JOINTS.issuperset(of_people) else of_bodies
    has = not of_people or any(np.isfinite(joints_of(clip).joints).any() for clip in origin.clips)
    chosen = dict.fromkeys(forms if has else ())
    written = [path for form in chosen for path in EXPORTS[form](origin, out)]
    if not written:
        raise InputError(
            f"--format {' --format '.join(of_people or forms)}",
            expected="a person with joints",
            found="none: people have positions on the pitch only, or there are none",
            todo="Choose a format of positions: positions, minimap or csv.",
        )
    clips, plane = best_results.find_clips(origin.run.record), best_results.PLANE
    on_plane = [clip for clip in clips if f"{plane}/{clip}" in origin.run]
    if kinds := {clip: best_results.person_kinds(origin.run, clip) for clip in on_plane}:
        written.append(manifests.write_kinds(out, kinds))
    return written


def keep_run(store: Store, origin: best_results.Origin, name: str) -> bool:
    """Pin the run of a release, never to be garbage collected; return whether the pin is new.

    InputError if a pin cannot have this name, or another run of the match has it.
    """
    record = origin.run.record
    new = read_pin(store.blobs, record.match_id, f"release-{name}") is None
    pin = Pin(
        match_id=record.match_id,
        name=f"release-{name}",
        run_id=record.run_id,
        who="worldpose export",
        why=f"release {name}",
        pinned_at=datetime.now(UTC),
    )
    pin_run(store.blobs, pin)
    return new


def release(
    store: Store, origin: best_results.Origin, forms: list[str], out: Path, name: str, licence: str
) -> list[Path]:
    """Write a release: the formats, origins/<clip>.npz and manifest.json; return the files.

    A release is frozen: its folder accepts only the same release again, or UsageError. Its run is
    pinned. InputError if another run of the match was released under this name, or the folder
    cannot be written.
    """
    if out.suffix == VIEWER_SUFFIX:
        raise _file_for_folder(out, forms)
    # As the poses next to them.
    origin = replace(origin, licence=licence, definition="body")
    record, spec = origin.run.record, origin.spec
    frozen = manifests.read_manifest(out)
    ours = {
        "release": name,
        "match_id": spec.match_id,
        "run_id": record.run_id,
        "formats": tuple(dict.fromkeys(forms)),
        "stage": origin.stage,
        "definition": origin.definition,
        "licence": licence,
        "results": record.results,
    }
    if frozen is not None and any(getattr(frozen, key) != value for key, value in ours.items()):
        raise UsageError(
            f"--out {out}",
            expected=f"a new folder, or release {name} of run {record.run_id} in the same formats",
            found=f"release {frozen.release} of run {frozen.run_id} of {frozen.match_id}",
            todo="Choose another folder: a release is never overwritten.",
        )
    # First, so that the run cannot be collected while its files are written.
    keep_run(store, origin, name)

    def claim(folder: Path, drafts: Mapping[str, Path]) -> None:
        released = f"{RELEASE}{name} of {spec.match_id}"
        owners = released, spec.match_id
        own_whole(
            folder,
            drafts,
            best_results.all_clips(origin.run),
            owners,
            overwrite=False,
            record=False,
            cameras=origin.static_cameras,
        )

    return write_whole(out, lambda place: _write_release(origin, forms, place, ours), claim)


def _write_release(
    origin: best_results.Origin, forms: list[str], out: Path, ours: Mapping[str, Any]
) -> list[Path]:
    """Write the files of a release; the manifest, with these entries, is the last."""
    record, spec = origin.run.record, origin.spec
    written = _export(origin, forms, out)
    clips = {}
    for clip in origin.clips:
        tracks = origin.tracks(clip)
        origins = manifests.origins_of(tracks)
        written.append(out / "origins" / f"{clip}.npz")
        manifests.write_origins(written[-1], tracks, origins)
        counts = np.bincount(origins.ravel(), minlength=len(manifests.ORIGINS))
        clips[clip] = ReleasedClip(
            first_frame=int(tracks.frames[0]) if len(tracks.frames) else 0,
            frame_count=len(tracks.frames),
            person_ids=tuple(tracks.person_ids.tolist()),
            origins=dict(zip(manifests.ORIGINS, counts.tolist(), strict=True)),
        )
    bodies = [best_results.bodies_unit(origin.run, clip) for clip in origin.clips]
    models = {origin.run[unit].attrs["body_model"] for unit in bodies if unit in origin.run}
    sizes = {camera.id: (camera.width, camera.height) for camera in spec.cameras}
    pictures = {name: sizes[name] for name in origin.static_cameras}
    views = [each for each in spec.broadcast_views.items() if each[1].clip.id in clips]
    manifest = ReleaseManifest(
        **ours,
        fps=spec.fps,
        clips=clips,
        pictures=pictures | {name: sizes[view.camera.id] for name, view in views},
        pitch=spec.pitch != NO_PITCH,
        body_model=models.pop() if len(models) == 1 else None,
        usability=record.usability,
        worldpose=version("worldpose"),
        versions=record.versions,
        settings=record.settings,
        files=manifests.released_files(out, written),
    )
    return [*written, manifests.write_manifest(out, manifest)]
