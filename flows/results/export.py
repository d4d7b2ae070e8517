"""Export formats of a run's results."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.pin import Pin
from data_contracts.release import BaselineSettings, ReleasedClip, ReleaseManifest
from flows.results.best_results import (
    PLANE,
    Origin,
    bodies_unit,
    broadcast_camera,
    camera_in_frames,
    clip_positions,
    estimated_pitch,
    fitted_bodies,
    person_kinds,
    placed_joints,
    static_cameras,
)
from flows.results.outputs import RELEASE, record_owner, require_own
from flows.results.tool_exports import TOOL_EXPORTS
from worldpose.dataset.manifest import (
    FRAME_RATES,
    KINDS,
    ORIGINS,
    origins_of,
    read_manifest,
    released_files,
    write_frame_rates,
    write_kinds,
    write_manifest,
    write_origins,
)
from worldpose.errors import InputError, UsageError
from worldpose.formats.baselines.result import (
    write_baseline_settings,
    write_slahmr_cameras,
    write_tracks,
)
from worldpose.formats.challenge import (
    ChallengeClip,
    Edition,
    challenge_truth,
    write_challenge,
    write_challenge_camera,
    write_moving_camera,
    write_pitch_points,
    write_static_camera,
    write_submission,
)
from worldpose.formats.files import FULL
from worldpose.formats.joints_file import write_joints, write_poses
from worldpose.formats.motion_capture import coco_dataset, write_coco
from worldpose.formats.tables import write_positions
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.pitch.template import PitchTemplate
from worldpose.store.runs import pin_run
from worldpose.store.store import Store
from worldpose.video.files import write_video

PITCH_SPACING = 0.5
"""Spacing of the points in pitch_points.txt [m]."""


def export_joints(origin: Origin, out: Path) -> list[Path]:
    """Write `joints.npz`, or `<clip>.joints.npz` per clip if there are several."""
    written = []
    for clip in origin.clips:
        path = out / ("joints.npz" if len(origin.clips) == 1 else f"{clip}.joints.npz")
        write_joints(path, origin.tracks(clip))
        written.append(path)
    return written


def export_coco(origin: Origin, out: Path) -> list[Path]:
    """Write `<camera>.json` for each static camera, in `<clip>/` if there are several.

    Raises:
        UsageError: the match has no static cameras.
    """
    if not origin.spec.static_cameras:
        raise UsageError(
            "--format coco",
            expected="a match with static cameras, whose keypoints this format holds",
            found="a match with a broadcast camera alone",
            todo="Choose another format, such as joints.",
        )
    written = []
    for clip in origin.clips:
        tracks = origin.tracks(clip)
        inliers = placed_joints(origin.run, clip)["inliers"]
        cameras = static_cameras(origin.run, origin.spec, origin.stage)
        for camera_id, camera in cameras.items():
            dataset = coco_dataset(
                camera_id,
                camera,
                tracks,
                inliers.sel(camera=camera_id).values,
                offset_frames=int(origin.spec.camera(camera_id).offset_frames),
            )
            path = (out if len(origin.clips) == 1 else out / clip) / f"{camera_id}.json"
            write_coco(path, dataset)
            written.append(path)
    return written


def export_worldpose(origin: Origin, out: Path) -> list[Path]:
    """Write `poses/<clip>.npz` and `cameras/<clip or static camera>.npz` (X3)."""
    written = []
    for clip in origin.clips:
        model, poses, _ = fitted_bodies(origin.run, clip)
        written.append(out / "poses" / f"{clip}.npz")
        write_poses(written[-1], poses, model.name)
        if f"broadcast_calibration/{clip}" in origin.run:
            written.append(out / "cameras" / f"{clip}.npz")
            write_moving_camera(written[-1], broadcast_camera(origin.run, clip))
    for name, camera in static_cameras(origin.run, origin.spec, origin.stage).items():
        written.append(out / "cameras" / f"{name}.npz")
        write_static_camera(written[-1], camera.to_calibration(name))
    return written


def export_challenge(origin: Origin, out: Path, edition: Edition = 2026) -> list[Path]:
    """Write cameras, boxes, skeletons, pitch points and the submission."""
    pitch = read_match(Path(origin.registration.folder)).pitch
    for clip in origin.clips:
        fitted_bodies(origin.run, clip)
        broadcast_camera(origin.run, clip)
    written = []
    together: dict[str, ChallengeClip] = {}
    submissions: dict[str, NDArray[np.float64]] = {}
    for clip in origin.clips:
        camera = broadcast_camera(origin.run, clip)
        model, poses, _ = fitted_bodies(origin.run, clip)
        truth = challenge_truth(model, poses, camera)
        submissions[clip] = truth.submission
        written.append(out / "cameras" / f"{clip}.npz")
        write_challenge_camera(written[-1], camera, edition)
        if edition == 2025:
            together[clip] = truth.clip
        else:
            written += write_challenge(out, {clip: truth.clip}, edition)
    if edition == 2025:
        written += write_challenge(out, together, edition)
    if pitch is not None:
        written.append(out / "pitch_points.txt")
        samples = PitchTemplate.from_spec(pitch).sample_lines(PITCH_SPACING)
        write_pitch_points(written[-1], samples.points_world)
    written.append(out / "submission.zip")
    write_submission(written[-1], submissions)
    return written


def export_challenge_2025(origin: Origin, out: Path) -> list[Path]:
    """Write the files of `export_challenge` in the 2025 layout."""
    return export_challenge(origin, out, 2025)


def export_tracks(origin: Origin, out: Path) -> list[Path]:
    """Write `tracks/<clip>.txt`, our boxes in the broadcast image, and the paper's settings."""
    written = [out / "baseline_settings.json"]
    write_baseline_settings(written[0], BaselineSettings())
    for clip in origin.clips:
        model, poses, persons = fitted_bodies(origin.run, clip)
        truth = challenge_truth(model, poses, broadcast_camera(origin.run, clip))
        written.append(out / "tracks" / f"{clip}.txt")
        write_tracks(written[-1], truth.clip.boxes, persons[truth.persons].astype(np.int64))
    return written


def export_slahmr_cameras(origin: Origin, out: Path) -> list[Path]:
    """Write `slahmr/cameras/<clip>/shot-0/cameras.npz`, and the paper's settings."""
    written = [out / "baseline_settings.json"]
    write_baseline_settings(written[0], BaselineSettings())
    for clip in origin.clips:
        written.append(out / "slahmr" / "cameras" / clip / "shot-0" / "cameras.npz")
        write_slahmr_cameras(written[-1], broadcast_camera(origin.run, clip))
    return written


def export_recording(origin: Origin, out: Path) -> list[Path]:
    """Write `rerun/<clip>.rrd` for the rerun viewer."""
    # Imported here: it loads matplotlib's colours, which takes 0.5 s.
    from worldpose.reports.rerun_recording import write_recording

    written = []
    for clip in origin.clips:
        tracks = origin.tracks(clip)
        known = f"broadcast_calibration/{clip}" in origin.run
        moving = camera_in_frames(origin.run, clip, tracks.frames) if known else None
        written.append(out / "rerun" / f"{clip}.rrd")
        write_recording(
            written[-1],
            tracks,
            origin.spec.fps,
            cameras=static_cameras(origin.run, origin.spec, origin.stage),
            broadcast=moving,
            pitch=estimated_pitch(
                origin.run,
                read_match(Path(origin.registration.folder)).pitch,
                origin.spec,
                clip,
            ),
        )
    return written


def export_positions(origin: Origin, out: Path) -> list[Path]:
    """Write `positions/<clip>.csv`: people on the pitch, triangulated or placed by their feet."""
    written = []
    for clip in origin.clips:
        written.append(out / "positions" / f"{clip}.csv")
        write_positions(written[-1], clip_positions(origin.run, clip), origin.spec.fps)
    return written


def export_minimap(origin: Origin, out: Path) -> list[Path]:
    """Write `minimap/<clip>.mp4`: the pitch from above with all people and their kind.

    Raises:
        UsageError: the match has no pitch.
    """
    # Imported here: it loads matplotlib's colours, which takes 0.5 s.
    from worldpose.reports.videos import minimap_frames

    pitch = read_match(Path(origin.registration.folder)).pitch
    if pitch is None:
        raise UsageError(
            "--format minimap",
            expected="a match with a pitch",
            found="a match without one",
            todo="Choose another format, such as joints.",
        )
    written = []
    for clip in origin.clips:
        written.append(out / "minimap" / f"{clip}.mp4")
        written[-1].parent.mkdir(parents=True, exist_ok=True)
        frames = minimap_frames(clip_positions(origin.run, clip), pitch)
        write_video(written[-1], frames, origin.spec.fps)
    return written


def export_viewer(origin: Origin, out: Path) -> list[Path]:
    """Write `viewer/<clip>.html`, or one file with all clips where `out` ends with .html.

    Raises:
        UsageError: a video is asked for, and no camera of a clip has one.
    """
    # Imported here: it loads matplotlib, which takes 0.5 s.
    from flows.reports.viewer import write_viewers

    return write_viewers(origin, out)


EXPORTS: dict[str, Callable[[Origin, Path], list[Path]]] = {
    "joints": export_joints,
    "coco": export_coco,
    "worldpose": export_worldpose,
    "positions": export_positions,
    "minimap": export_minimap,
    **TOOL_EXPORTS,
    "viewer": export_viewer,
    "challenge": export_challenge,
    "challenge-2025": export_challenge_2025,
    "tracks": export_tracks,
    "slahmr-cameras": export_slahmr_cameras,
    "rerun": export_recording,
}
"""Name in `EXPORT_FORMATS` to function, which takes the source and a folder, returns the files."""


CLASHING = {"worldpose", "challenge", "challenge-2025"}
"""Formats with the same file names; a folder can hold one of them."""
SHARED = {FRAME_RATES, KINDS}
"""Files to which exports of further clips are added."""
VIEWER_SUFFIX = ".html"
"""An output that ends so is one viewer file, not a folder."""
COUNTED = {"joints", *CLASHING}
"""Formats that `check` and `statistics` read, and that lack the frame rate."""


def export(origin: Origin, forms: list[str], out: Path, *, overwrite: bool = False) -> list[Path]:
    """Write a run in several formats into one folder; return the files.

    Formats that `check` and `statistics` read also get frame_rates.json, and filled joints get
    origins/<clip>.npz, which flags them. Earlier files of the same match are replaced.

    Args:
        origin: the run.
        forms: names of the formats.
        out: the folder, or a file of the viewer.
        overwrite: also replace files of another match or of unknown origin.

    Raises:
        UsageError: an unknown format, two with the same file names, or a file in place of a folder.
        InputError: the folder cannot be written, holds a file of the same name of another match, or
            a format's results are missing. Nothing is written then.
    """
    if out.suffix == VIEWER_SUFFIX and set(forms) != {"viewer"}:
        raise _file_for_folder(out, forms)

    def write(place: Path) -> list[Path]:
        written = _export(origin, forms, place)
        if not written:
            raise InputError(
                f"--format {' --format '.join(forms)}",
                expected="a person with joints",
                found="none: people have positions on the pitch only, or there are none",
                todo="Choose a format of positions: positions, minimap or csv.",
            )
        for clip in origin.clips if origin.filled and out.suffix != VIEWER_SUFFIX else ():
            tracks = origin.tracks(clip)
            written.append(place / "origins" / f"{clip}.npz")
            write_origins(written[-1], tracks, origins_of(tracks))
        if not COUNTED & set(forms):
            return written
        rates = dict.fromkeys(origin.clips, origin.spec.fps)
        return [*written, write_frame_rates(place, rates)]

    match_id = origin.spec.match_id

    def claim(folder: Path, drafts: Mapping[str, Path]) -> None:
        require_own(folder, drafts, (match_id,), overwrite=overwrite)
        record_owner(folder, drafts, match_id)

    return _write_whole(out, write, claim)


def _write_whole(
    out: Path,
    write: Callable[[Path], list[Path]],
    claim: Callable[[Path, Mapping[str, Path]], None],
) -> list[Path]:
    """Write files to a temporary place next to `out`, then move all of them; return them there.

    An error while they are written leaves `out` as it was.

    Args:
        out: a folder, or a file of the viewer.
        write: writes into a folder, or a file, and returns the files.
        claim: refuses to replace files of a folder, given their drafts by name.

    Raises:
        InputError: `out` cannot be written, or one of its files is a folder.
    """
    is_file = out.suffix == VIEWER_SUFFIX
    if out.exists() and out.is_dir() == is_file:
        raise _unwritable(out, "a folder" if is_file else "a file")
    above = out if out.is_dir() else out.parent
    absent = [place for place in (above, *above.parents) if not place.exists()]
    try:
        above.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=above) as workshop:
            place = Path(workshop) / out.name
            if not is_file:
                place.mkdir()
                for name in (FRAME_RATES, KINDS):  # further clips are added to them
                    if (out / name).is_file():
                        shutil.copyfile(out / name, place / name)
            try:
                written = write(place)
            except InputError as error:
                # A message about a file names it where it was to be.
                where = error.where.replace(str(place), str(out))
                raise type(error)(
                    where, expected=error.expected, found=error.found, todo=error.todo
                ) from error
            targets = {path: out / path.relative_to(place) for path in written}
            if is_file:
                targets = dict.fromkeys(written, out)
            for target in targets.values():
                if target.is_dir():
                    raise _unwritable(target, "a folder")
            above_files = out.parent if is_file else out
            claim(
                above_files,
                {
                    target.relative_to(above_files).as_posix(): path
                    for path, target in targets.items()
                    if target.name not in SHARED
                },
            )
            for path, target in targets.items():
                target.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target)
    except OSError as error:
        _remove_empty(absent)
        named = str(error.filename or "")
        if error.errno in FULL or named.startswith((str(above), str(out))):
            raise _unwritable(out, error.strerror or str(error)) from error
        raise
    except BaseException:
        _remove_empty(absent)
        raise
    return list(targets.values())


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders that were made, the innermost first, up to one with content."""
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:
            return


def _unwritable(out: Path, found: str) -> InputError:
    return InputError(
        f"--out {out}",
        expected="a folder that can be written, or with --format viewer a file FILE.html",
        found=found,
        todo="Choose another place, or free space and rights there; nothing was written.",
    )


def _file_for_folder(out: Path, forms: list[str]) -> UsageError:
    return UsageError(
        f"--out {out}",
        expected="a folder; a file only with --format viewer alone, and not for a release",
        found=f"the name of a file, with --format {' --format '.join(forms)}",
        todo="Give the name of a folder.",
    )


def _export(origin: Origin, forms: list[str], out: Path) -> list[Path]:
    """Write formats like `export`, also for a release, whose manifest has the frame rate.

    If a broadcast camera alone films people, kinds.json tells that they are not triangulated.
    """
    for form in forms:
        if form not in EXPORTS:
            raise UsageError(
                f"--format {form}",
                expected=f"one of {', '.join(EXPORTS)}",
                found=repr(form),
                todo="Choose one of these.",
            )
    if len(clashing := CLASHING & set(forms)) > 1:
        raise UsageError(
            f"--format {' --format '.join(sorted(clashing))}",
            expected="formats with different file names",
            found="formats that all write cameras/<clip>.npz",
            todo="Export them into different folders.",
        )
    written = [path for form in dict.fromkeys(forms) for path in EXPORTS[form](origin, out)]
    on_plane = [clip for clip in origin.clips if f"{PLANE}/{clip}" in origin.run]
    if on_plane:
        kinds = {clip: person_kinds(origin.run, clip) for clip in on_plane}
        written.append(write_kinds(out, kinds))
    return written


def _keep(store: Store, origin: Origin, name: str) -> None:
    """Pin the run of a release, so that its results are never garbage collected."""
    record = origin.run.record
    pin = Pin(
        match_id=record.match_id,
        name=f"release-{name}",
        run_id=record.run_id,
        who="worldpose export",
        why=f"release {name}",
        pinned_at=datetime.now(UTC),
    )
    pin_run(store.blobs, pin)


def release(
    store: Store, origin: Origin, forms: list[str], out: Path, name: str, licence: str
) -> list[Path]:
    """Write a release: the formats, origins/<clip>.npz and manifest.json; return the files.

    A release is frozen: its folder accepts only the same release again. Its run is pinned.

    Raises:
        UsageError: the folder holds another release.
        InputError: another run of the match was released under this name, or the folder cannot be
            written.
    """
    if out.suffix == VIEWER_SUFFIX:
        raise _file_for_folder(out, forms)
    origin = replace(origin, licence=licence)
    record, spec = origin.run.record, origin.spec
    frozen = read_manifest(out)
    ours = {
        "release": name,
        "match_id": spec.match_id,
        "run_id": record.run_id,
        "formats": tuple(dict.fromkeys(forms)),
        "stage": origin.stage,
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
    _keep(store, origin, name)

    def claim(folder: Path, drafts: Mapping[str, Path]) -> None:
        released = f"{RELEASE}{name} of {spec.match_id}"
        require_own(folder, drafts, (released, spec.match_id), overwrite=False)

    return _write_whole(out, lambda place: _write_release(origin, forms, place, ours), claim)


def _write_release(
    origin: Origin, forms: list[str], out: Path, ours: Mapping[str, Any]
) -> list[Path]:
    """Write the files of a release; the manifest, with these entries, is the last."""
    record, spec = origin.run.record, origin.spec
    written = _export(origin, forms, out)
    clips = {}
    for clip in origin.clips:
        tracks = origin.tracks(clip)
        origins = origins_of(tracks)
        written.append(out / "origins" / f"{clip}.npz")
        write_origins(written[-1], tracks, origins)
        counts = np.bincount(origins.ravel(), minlength=len(ORIGINS))
        clips[clip] = ReleasedClip(
            first_frame=int(tracks.frames[0]) if len(tracks.frames) else 0,
            frame_count=len(tracks.frames),
            person_ids=tuple(tracks.person_ids.tolist()),
            origins=dict(zip(ORIGINS, counts.tolist(), strict=True)),
        )
    bodies = [bodies_unit(origin.run, clip) for clip in origin.clips]
    models = {origin.run[unit].attrs["body_model"] for unit in bodies if unit in origin.run}
    cameras = static_cameras(origin.run, spec, origin.stage)
    pictures = {camera.id: (camera.width, camera.height) for camera in spec.cameras}
    manifest = ReleaseManifest(
        **ours,
        fps=spec.fps,
        clips=clips,
        pictures={
            **{camera: pictures[camera] for camera in cameras},
            **{c.id: pictures[c.broadcast] for c in spec.clips if c.broadcast and c.id in clips},
        },
        pitch=spec.pitch != NO_PITCH,
        body_model=models.pop() if len(models) == 1 else None,
        worldpose=version("worldpose"),
        versions=record.versions,
        settings=record.settings,
        files=released_files(out, written),
    )
    return [*written, write_manifest(out, manifest)]
