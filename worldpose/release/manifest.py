"""manifest.json: what a release is, what it was made from, and how to prove that it is whole."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, JsonValue, ValidationError

from data_contracts.conventions import CONVENTIONS, Conventions
from data_contracts.records import CONTRACT_VERSION, Digest, Key, Name, Record
from worldpose.errors import InputError
from worldpose.release.files import whole_file

MANIFEST: Final = "manifest.json"


class ReleasedFile(Record):
    """One file of a release."""

    path: str
    """Relative to the manifest, with forward slashes."""
    size: int
    """[byte]"""
    sha256: Digest


class ReleasedClip(Record):
    """One clip of a release."""

    first_frame: int
    """Match frame of the first row of every array."""
    frame_count: int
    person_ids: tuple[int, ...]
    """People in the order of every person dimension."""
    origins: dict[str, int]
    """How many joints are of which origin; each joint's is in origins/<clip>.npz."""


class ReleaseManifest(Record):
    """A named, frozen run: the same name, run and licence give the same bytes."""

    contract: Literal[1] = CONTRACT_VERSION
    release: Name
    match_id: Name
    run_id: Name
    formats: tuple[str, ...]
    stage: str | None = None
    """Whose joints were asked for; None = the best there are."""
    fps: float = Field(gt=0)
    """[1/s]"""
    clips: dict[str, ReleasedClip]
    pictures: dict[str, tuple[int, int]]
    """Width and height [px] of every camera's picture."""
    pitch: bool
    """Whether the world is a pitch's; without one it is that of the cameras' calibration."""
    body_model: str | None
    """Name and version of the body model of all poses; betas of another mean nothing."""
    conventions: Conventions = CONVENTIONS
    licence: str = Field(min_length=1)
    """The text under which the owner of the data gives it out."""
    worldpose: str
    """Version that wrote the release."""
    versions: dict[str, str]
    """Python and numeric libraries that computed it."""
    settings: dict[str, dict[str, JsonValue]]
    """Stage to all its settings."""
    results: dict[str, Key]
    """Stored results that it was made from: `stage/unit` to key."""
    files: tuple[ReleasedFile, ...]


def released_files(folder: Path, paths: Iterable[Path]) -> tuple[ReleasedFile, ...]:
    """Sizes and checksums of files in `folder`, by name."""
    files = []
    for path in sorted(paths):
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        name = path.relative_to(folder).as_posix()
        files.append(ReleasedFile(path=name, size=path.stat().st_size, sha256=sha256))
    return tuple(files)


def write_manifest(folder: Path, manifest: ReleaseManifest) -> Path:
    """Write manifest.json, whole or not at all; returns it."""
    with whole_file(folder / MANIFEST) as draft:
        draft.write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return folder / MANIFEST


def read_manifest(folder: Path) -> ReleaseManifest | None:
    """The manifest of a release; None where the folder has none.

    Raises:
        InputError: it is no manifest, or one of another contract.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return None
    try:
        return ReleaseManifest.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise InputError(
            str(path),
            expected=f"the manifest of a release, contract {CONTRACT_VERSION}",
            found=str(error.errors()[0]["msg"]),
            todo="Take the release anew from its origin.",
        ) from error


def changed_files(folder: Path, manifest: ReleaseManifest) -> list[str]:
    """Names of released files that are gone or have other bytes."""
    changed = []
    for file in manifest.files:
        path = folder / file.path
        if not path.is_file() or released_files(folder, [path])[0] != file:
            changed.append(file.path)
    return changed
