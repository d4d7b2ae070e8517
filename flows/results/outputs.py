"""Whose files a folder of outputs holds: no command replaces those of another match silently."""

from __future__ import annotations

import filecmp
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError

from worldpose.dataset.manifest import MANIFEST, read_manifest
from worldpose.errors import InputError
from worldpose.formats.files import whole_file

OWNERS: Final = ".worldpose-outputs"
"""File in a folder of outputs with the owner of each: a match, a data set, or another input."""
RELEASE: Final = "release "
"""Begins the owner of released files, which nothing replaces."""
_OWNERS: Final = TypeAdapter(dict[str, str])


def read_owners(folder: Path) -> dict[str, str]:
    """Return the owner of the files in a folder, by name; files of unknown origin are left out."""
    try:
        owners = _OWNERS.validate_json((folder / OWNERS).read_bytes())
    except (FileNotFoundError, ValidationError):
        owners = {}
    manifest = read_manifest(folder)
    if manifest is not None:
        released = (MANIFEST, *(file.path for file in manifest.files))
        owners |= dict.fromkeys(released, f"{RELEASE}{manifest.release} of {manifest.match_id}")
    return owners


def require_own(
    folder: Path, drafts: Mapping[str, Path | None], owners: tuple[str, ...], *, overwrite: bool
) -> None:
    """Refuse to replace files of another owner or of unknown origin.

    Args:
        folder: folder of the files.
        drafts: name of each file in it to its new content; None if that does not exist yet.
        owners: owners whose files may be replaced.
        overwrite: replace any files but those of a release.

    Raises:
        InputError: a file with other content has another owner.
    """
    known = read_owners(folder)
    for name, draft in drafts.items():
        path, owner = folder / name, known.get(name, "unknown origin")
        if owner in owners or not path.is_file():
            continue
        if overwrite and not owner.startswith(RELEASE):
            continue
        if draft is not None and filecmp.cmp(path, draft, shallow=False):
            continue
        raise InputError(
            str(path),
            expected=f"no file yet, or one of {owners[0]}",
            found=f"a file of {owner}",
            todo="Choose another name or folder, or move the file away; export and report also "
            "have --overwrite. Nothing was written.",
        )


def record_owner(folder: Path, names: Mapping[str, Path | None], owner: str) -> None:
    """Record the owner of files in a folder."""
    owners = {**read_owners(folder), **dict.fromkeys(names, owner)}
    with whole_file(folder / OWNERS) as draft:
        draft.write_text(json.dumps(owners, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def claim_file(file: Path | None, owner: str, *, overwrite: bool = False) -> None:
    """Record the owner of a file that a command writes next; without a file do nothing.

    Raises:
        InputError: the file exists and has another owner.
    """
    if file is not None:
        require_own(file.parent, {file.name: None}, (owner,), overwrite=overwrite)
        record_owner(file.parent, {file.name: None}, owner)


def require_new(file: Path | None) -> None:
    """Refuse to replace a file that people edit.

    Raises:
        InputError: the file exists.
    """
    if file is not None and file.exists():
        raise InputError(
            str(file),
            expected="a new file",
            found="a file",
            todo="Choose another name, or move the file away. Nothing was written.",
        )
