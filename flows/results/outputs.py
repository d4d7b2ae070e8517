"""Files that commands write: whole or not at all, and over no other match's files silently."""

from __future__ import annotations

import filecmp
import json
import shutil
import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError

from worldpose.dataset.manifest import FRAME_RATES, KINDS, LENS_ERRORS, MANIFEST, read_manifest
from worldpose.errors import InputError
from worldpose.formats.files import FULL, whole_file

OWNERS: Final = ".worldpose-outputs"
"""File in a folder of outputs with the owner of each: a match, a data set, or another input."""
VIEWER_SUFFIX: Final = ".html"
"""An output that ends so is one viewer file, not a folder."""
RELEASE: Final = "release "
"""Begins the owner of released files, which nothing replaces."""
SHARED: Final = frozenset({FRAME_RATES, KINDS, LENS_ERRORS})
"""Files to which exports of further clips and cameras are added."""
_OWNERS: Final = TypeAdapter(dict[str, str])


def read_owners(folder: Path) -> dict[str, str]:
    """Return the owner of the files in a folder, by name; files of unknown origin are left out."""
    try:
        owners = _OWNERS.validate_json((folder / OWNERS).read_bytes())
    except (FileNotFoundError, ValidationError):
        owners = {}
    manifest = read_manifest(folder)
    if manifest is not None:
        files = {file.path for file in manifest.files}
        entries = (
            f"{name}: {each}"
            for name in SHARED & files
            for each in (manifest.pictures if name == LENS_ERRORS else manifest.clips)
        )
        released = (MANIFEST, *files, *entries)
        owners |= dict.fromkeys(released, f"{RELEASE}{manifest.release} of {manifest.match_id}")
    return owners


def require_own(
    folder: Path, drafts: Mapping[str, Path | None], owners: tuple[str, ...], *, overwrite: bool
) -> None:
    """Refuse to replace files of another owner or of unknown origin.

    `drafts` maps the name of each file to its new content, None if that does not exist yet. With
    `overwrite`, only files of a release are refused.
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


def own_whole(
    folder: Path,
    drafts: Mapping[str, Path],
    clips: Collection[str],
    owners: tuple[str, ...],
    *,
    overwrite: bool,
    record: bool = True,
    cameras: Collection[str] = (),
) -> None:
    """Record the first owner of files and of clips' entries in shared ones; or refuse.

    An entry counts for all files of a clip of this name, so equal ones have several owners; its
    name is `FILE: CLIP`, or `FILE: CAMERA` for lens errors. Without it, the file's owner counts.
    """
    files = {name: draft for name, draft in drafts.items() if name not in SHARED}
    require_own(folder, files, owners, overwrite=overwrite)
    known, found = read_owners(folder), {}
    for name in SHARED & drafts.keys():
        path = folder / name
        both = (path, drafts[name])
        old, new = (json.loads(file.read_bytes()) if file.is_file() else {} for file in both)
        for clip in sorted(new.keys() & set(cameras if name == LENS_ERRORS else clips)):
            before = known.get(name, "unknown origin") if clip in old else owners[0]
            before = known.get(f"{name}: {clip}", before) if clip in old else before
            other, same = before not in owners, old.get(clip, new[clip]) == new[clip]
            if other and not same and (not overwrite or before.startswith(RELEASE)):
                raise InputError(
                    f"{path}: {clip}",
                    expected=f"{new[clip]}, or no clip or camera of this name of another match",
                    found=f"{old[clip]}, of {before}",
                    todo="Choose another folder, or rename the clip or camera. "
                    "Nothing was written.",
                )
            all_ = before if owners[0] in before.split(" and ") else f"{before} and {owners[0]}"
            found[f"{name}: {clip}"] = all_ if same else owners[0]
    if record:
        record_owner(folder, files, owners[0], found)


def record_owner(
    folder: Path,
    names: Mapping[str, Path | None],
    owner: str,
    entries: Mapping[str, str] | None = None,
) -> None:
    """Record the owner of files in a folder, and those of entries in shared files."""
    owners = {**read_owners(folder), **dict.fromkeys(names, owner), **(entries or {})}
    with whole_file(folder / OWNERS) as draft:
        draft.write_text(json.dumps(owners, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def claim_file(file: Path | None, owner: str) -> None:
    """Record the owner of a file that a command writes next; without a file do nothing.

    InputError if the file exists and has another owner.
    """
    if file is not None:
        require_own(file.parent, {file.name: None}, (owner,), overwrite=False)
        record_owner(file.parent, {file.name: None}, owner)


def require_new(file: Path | None) -> None:
    """Refuse to replace a file that people edit."""
    if file is not None and file.exists():
        raise InputError(
            str(file),
            expected="a new file",
            found="a file",
            todo="Choose another name, or move the file away. Nothing was written.",
        )


def write_whole(
    out: Path,
    write: Callable[[Path], list[Path]],
    claim: Callable[[Path, Mapping[str, Path]], None],
) -> list[Path]:
    """Write files to a temporary place next to `out`, then move all of them; return them there.

    An error while they are written leaves `out` as it was. `claim` refuses to replace files of a
    folder, given their drafts by name. This call adds to `SHARED` files, whose entries have owners.
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
                for name in SHARED:
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
            owned = out.parent if is_file else out
            claim(owned, {to.relative_to(owned).as_posix(): path for path, to in targets.items()})
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
