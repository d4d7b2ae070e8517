"""manifest.json: name, sources and checksums of a release."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveFloat, TypeAdapter, ValidationError

from data_contracts.arrays import Flags
from data_contracts.records import CONTRACT_VERSION
from data_contracts.release import DataSetManifest, ReleaseManifest, RigCamera
from data_contracts.run import StoredFile
from worldpose.errors import InputError
from worldpose.formats.archives import write_archive
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.ingest.match_folder import spec_around

MANIFEST: Final = "manifest.json"
DATA_SET: Final = "release.json"
"""Manifest of a data set of several matches."""
T = TypeVar("T")


def _read(path: Path, form: TypeAdapter[T], expected: str, todo: str) -> T | None:
    """Read a JSON file of a form; None if there is none, InputError if it is damaged."""
    if not path.is_file():
        return None
    try:
        return form.validate_json(path.read_bytes())
    except ValidationError as error:
        errors = error.errors()
        found = f"{'.'.join(map(str, errors[0]['loc']))}: {errors[0]['msg']}".removeprefix(": ")
        if all(each["type"] in ("missing", "extra_forbidden") for each in errors):
            found = f"{found}: another version of worldpose wrote it"
            todo = f"{todo} Or write it again with this version."
        raise InputError(str(path), expected=expected, found=found, todo=todo) from error


def _write(path: Path, content: object) -> Path:
    with whole_file(path) as draft:
        draft.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return path


def released_files(folder: Path, paths: Iterable[Path]) -> tuple[StoredFile, ...]:
    """Return sizes and checksums of files in `folder`, by name."""
    files = []
    for path in sorted(paths):
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        name = path.relative_to(folder).as_posix()
        files.append(StoredFile(path=name, size=path.stat().st_size, sha256=sha256))
    return tuple(files)


def write_manifest(folder: Path, manifest: ReleaseManifest | DataSetManifest) -> Path:
    """Write manifest.json or release.json, whole or not at all; return its path."""
    path = folder / (MANIFEST if isinstance(manifest, ReleaseManifest) else DATA_SET)
    with whole_file(path) as draft:
        draft.write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return path


def read_data_set(folder: Path) -> DataSetManifest:
    """Read release.json; InputError if there is none, or it is damaged."""
    path, todo = folder / DATA_SET, "Give the folder that worldpose release wrote."
    expected = f"the manifest of a data set, contract {CONTRACT_VERSION}"
    found = _read(path, TypeAdapter(DataSetManifest), expected, todo)
    if found is None:
        raise InputError(str(path), expected=expected, found="no such file", todo=todo)
    return found


def write_rigs(part: Path, rigs: Mapping[str, Mapping[str, RigCamera]]) -> None:
    """Write rigs.json, the static cameras of hidden clips."""
    told = {
        clip: {name: camera.model_dump(mode="json") for name, camera in rig.items()}
        for clip, rig in rigs.items()
    }
    _write(part / "rigs.json", told)


def read_rigs(part: Path) -> dict[str, dict[str, RigCamera]] | None:
    """Read rigs.json; None in an older release, which has none."""
    form = TypeAdapter(dict[str, dict[str, RigCamera]])
    expected, todo = "the static cameras of hidden clips", "Copy the truth again from its origin."
    return _read(part / "rigs.json", form, expected, todo)


def read_manifest(folder: Path) -> ReleaseManifest | None:
    """Read the manifest of a release; None if the folder has none."""
    return _read(
        folder / MANIFEST,
        TypeAdapter(ReleaseManifest),
        f"the manifest of a release, contract {CONTRACT_VERSION}",
        "Download or copy the release again from its origin.",
    )


def changed_files(folder: Path, files: Iterable[StoredFile]) -> list[str]:
    """Return the names of released files that are missing or changed."""
    changed = []
    for file in files:
        path = folder / file.path
        if not path.is_file() or released_files(folder, [path])[0] != file:
            changed.append(file.path)
    return changed


FRAME_RATES: Final = "frame_rates.json"
_RATES = TypeAdapter(dict[str, PositiveFloat])


KINDS: Final = "kinds.json"
"""File with the kind of every person: triangulated, mixed or plane."""
LENS_ERRORS: Final = "lens_errors.json"
"""File with the largest differences of the lenses in cameras/ from those of the run [px]."""


def write_kinds(folder: Path, kinds: Mapping[str, Mapping[int, str]]) -> Path:
    """Add the kinds of clips' people, by clip and id, to those in the folder; return the file."""
    path, expected = folder / KINDS, "clips and the kinds of their people by id"
    form = TypeAdapter(dict[str, dict[str, str]])
    known = _read(path, form, expected, "Remove the file, and export again.") or {}
    new = {clip: {str(person): kind for person, kind in of.items()} for clip, of in kinds.items()}
    return _write(path, known | new)


def write_lens_errors(
    folder: Path, errors: Mapping[str, Mapping[str, str | float | None] | None]
) -> Path | None:
    """Replace cameras' entries in the folder's lens errors; None leaves a camera out.

    Return the file; None if no camera has an entry before or after.
    """
    path, expected = folder / LENS_ERRORS, "cameras and the errors of their lenses"
    form = TypeAdapter(dict[str, dict[str, str | float | None]])
    known = _read(path, form, expected, "Remove the file, and export again.") or {}
    found = {name: each for name, each in {**known, **errors}.items() if each is not None}
    return _write(path, found) if known or found else None


def write_frame_rates(folder: Path, rates: Mapping[str, float]) -> Path:
    """Add clips' frames per second [1/s] to the folder's existing ones; return the file."""
    return _write(folder / FRAME_RATES, {**read_frame_rates(folder), **rates})


def read_frame_rates(folder: Path) -> dict[str, float]:
    """Read frames per second [1/s] by clip; empty if the folder has no such file."""
    path, expected = folder / FRAME_RATES, "clips and their frames per second"
    return _read(path, _RATES, expected, "Export the data set again.") or {}


def clip_frame_rate(rates: Mapping[str, float], clip: str) -> float | None:
    """Return the frame rate of a clip; without an entry (`joints.npz`), the common rate."""
    if clip in rates:
        return rates[clip]
    return next(iter(rates.values())) if len(set(rates.values())) == 1 else None


def stated_rate(folder: Path, clip: str) -> float | None:
    """Return the frame rate of a clip [1/s] that the folder states, or the match.yaml around it."""
    if (manifest := read_manifest(folder)) is not None:
        return manifest.fps
    rate = clip_frame_rate(read_frame_rates(folder), clip)
    try:
        around = spec_around(folder) if rate is None else None
    except InputError as error:
        todo = (
            f"{error.todo} Or, of another match, state the rate: --fps, or {folder}/{FRAME_RATES}."
        )
        raise InputError(error.where, error.expected, error.found, todo) from error
    return rate if around is None else around[1].fps


ORIGINS: Final = ("absent", "automatic", "filled", "corrected")
"""Meanings of the origin codes."""


def origins_of(tracks: JointTracks, corrected: Flags | None = None) -> NDArray[np.uint8]:
    """Return the origin of joints (frames, persons, 17), indices of `ORIGINS`.

    A joint without a contributing camera was filled in, from motion or from the rest of the body.

    A person set or confirmed `corrected` (frames, persons, 17). Unknown views count as seen.
    """
    origin = np.full(tracks.joints.shape[:3], ORIGINS.index("automatic"), dtype=np.uint8)
    if tracks.views is not None:
        origin[tracks.views == 0] = ORIGINS.index("filled")
    if corrected is not None:
        origin[corrected] = ORIGINS.index("corrected")
    origin[np.isnan(tracks.joints).any(-1)] = ORIGINS.index("absent")
    return origin


def write_origins(path: Path, tracks: JointTracks, origin: NDArray[np.uint8]) -> None:
    """Write origins/<clip>.npz: `frames`, `person_ids`, `origin`, and the meanings of its codes."""
    write_archive(
        path,
        {
            "frames": tracks.frames,
            "person_ids": tracks.person_ids,
            "origin": origin,
            "origin_names": np.array(ORIGINS),
        },
    )
