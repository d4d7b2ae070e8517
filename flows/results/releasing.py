"""Release: the frozen files of a named run, with a checksum manifest."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from data_contracts.pin import Pin
from data_contracts.release import ReleasedClip, ReleaseManifest
from flows.results.best_results import bodies_unit, joint_tracks, static_cameras
from flows.results.formats import EXPORTS, Origin
from worldpose.dataset.manifest import (
    ORIGINS,
    origins_of,
    read_manifest,
    released_files,
    write_frame_rates,
    write_manifest,
    write_origins,
)
from worldpose.errors import UsageError
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.store import Store, pin_run

CLASHING = {"worldpose", "challenge", "challenge-2025"}
"""Formats with the same file names; a folder can hold one of them."""
COUNTED = {"joints", *CLASHING}
"""Formats that `check` and `statistics` read, and that lack the frame rate."""


def export(origin: Origin, forms: list[str], out: Path) -> list[Path]:
    """Write a run in several formats into one folder; return the files.

    Formats that `check` and `statistics` read also get frame_rates.json.

    Raises:
        UsageError: an unknown format, or two with the same file names.
    """
    written = _export(origin, forms, out)
    if not COUNTED & set(forms):
        return written
    rates = dict.fromkeys(origin.clips, origin.spec.fps)
    return [*written, write_frame_rates(out, rates)]


def _export(origin: Origin, forms: list[str], out: Path) -> list[Path]:
    """Write formats like `export`, also for a release, whose manifest has the frame rate."""
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
            expected="formats that do not write the same files",
            found="each has its own cameras/<clip>.npz",
            todo="Export them into different folders.",
        )
    return [path for form in dict.fromkeys(forms) for path in EXPORTS[form](origin, out)]


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
        InputError: another run of the match was released under this name.
    """
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
            todo="A release is never overwritten: name another folder.",
        )
    # First, so that the run cannot be collected while its files are written.
    _keep(store, origin, name)
    written = _export(origin, forms, out)
    clips = {}
    for clip in origin.clips:
        tracks = joint_tracks(origin.run, clip, origin.stage)
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
