"""manifest.json: what a release is, what it was made from, and how to prove that it is whole."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from data_contracts.records import CONTRACT_VERSION
from data_contracts.release import ReleasedFile, ReleaseManifest
from worldpose.errors import InputError
from worldpose.release.files import whole_file

MANIFEST: Final = "manifest.json"


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
