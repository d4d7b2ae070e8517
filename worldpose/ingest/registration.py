"""Identity of a match: digests of all its files."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from data_contracts.match import Registration, SourceFile
from worldpose.errors import InputError, say_failure
from worldpose.formats.files import sha256_of_file
from worldpose.ingest.match_folder import LENS_FILE, MatchFolder
from worldpose.ingest.pitch_file import pitch_file
from worldpose.ingest.validation import reachable

READERS: Final = 2
"""Files of a match that are read at the same time."""
SETTLE_SECONDS: Final = 0.5
"""A file changed within this time [s] is checked again; recorders and copies write more often."""


def register_match(match: MatchFolder, previous: Registration | None) -> Registration:
    """Return the match with the SHA-256 of its files, and its identity.

    The registration covers match.yaml, calibration.toml, lenses.toml, the pitch file, videos,
    stills, detections, boxes, estimates and annotations; `reference/` is not part of the match. The
    identity covers only the paths and contents of videos, detections and pitch, so that neither the
    folder's name nor an edited click, still, roster, estimate or calibration changes it.

    A file with the size and modification time of the `previous` registration of this folder keeps
    its digest. As in git, this is only a shortcut: it misses a change that preserves both. A video
    of it that is gone keeps its digest, so that its results stay readable. InputError if a file is
    empty, unreadable, or still being written.
    """
    with reachable(match.folder):
        folder = str(match.folder.resolve())
        known: dict[tuple[str, int, int], str] = {}
        if previous is not None and previous.folder == folder:
            known = {
                (file.path, file.size, file.modified_ns): file.sha256 for file in previous.files
            }
        identifying = identifying_files(match)
        names = ("match.yaml", "calibration.toml", LENS_FILE, "annotations")
        roots = [*(match.folder / name for name in names), *match.stills.values()]
        roots += [*match.estimates.values(), *match.boxes.values(), *match.camera_data.values()]
        further = {path for root in roots for path in _files_under(match.folder, root)}
        gone = {
            file.path: file
            for file in (previous.files if known and previous else ())
            if match.folder / file.path in match.videos.values()
            and not (match.folder / file.path).exists()
        }
        paths = sorted(identifying | further)
        with ThreadPoolExecutor(READERS) as threads:
            files = tuple(threads.map(lambda path: _source_file(match.folder, path, known), paths))
        states = {match.folder / file.path: (file.size, file.modified_ns) for file in files}
        require_settled(states, "ingest again")
        files = tuple(sorted((*files, *gone.values()), key=lambda file: file.path))
        identity = hashlib.sha256()
        for file in files:
            if file.path in identifying or file.path in gone:
                identity.update(f"{file.sha256} {file.path}\n".encode())
        return Registration(
            spec=match.spec, folder=folder, identity=identity.hexdigest(), files=files
        )


def identifying_files(match: MatchFolder) -> set[str]:
    """Return the files that make the match what it is: those of videos, detections and pitch."""
    pitch = pitch_file(match.folder, match.spec)
    roots = [*match.videos.values(), *match.detections.values(), *([pitch] if pitch else [])]
    return {path for root in roots for path in _files_under(match.folder, root)}


def digest_of_files(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and contents of a folder's non-hidden files.

    Equals `Registration.digest_of` of the registered files; OSError if a file is unreadable.
    """
    if not path.is_dir():
        return sha256_of_file(path)
    listed = hashlib.sha256()
    for name in sorted(_files_under(path, path)):
        listed.update(f"{digest_of_files(path / name)} {name}\n".encode())
    return listed.hexdigest()


def _files_under(folder: Path, root: Path) -> list[str]:
    """Return `root`, or the non-hidden files in and below it, relative to the match folder."""
    if root.is_file():
        return [root.relative_to(folder).as_posix()]
    return [
        (Path(parent) / name).relative_to(folder).as_posix()
        for parent, _, names in os.walk(root, onerror=_raise_unless_absent)
        for name in names
        if not name.startswith(".")
    ]


def _raise_unless_absent(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error


def _source_file(folder: Path, path: str, known: dict[tuple[str, int, int], str]) -> SourceFile:
    try:
        before = (folder / path).stat()
        if before.st_size == 0:
            todo = "Copy it again, or wait until it is written."
            raise InputError(str(folder / path), "a file with content", "0 bytes", todo)
        sha256 = known.get((path, before.st_size, before.st_mtime_ns))
        if sha256 is None:
            sha256 = sha256_of_file(folder / path)
    except OSError as error:
        todo = "Check its rights, or wait until it is written."
        raise InputError(str(folder / path), "a readable file", say_failure(error), todo) from error
    return SourceFile(path=path, size=before.st_size, modified_ns=before.st_mtime_ns, sha256=sha256)


def file_state(path: Path) -> tuple[int, int]:
    """Return the size [byte] and time of change [ns] of a file or of a folder's; or OSError."""
    states = [file.stat() for file in (path.iterdir() if path.is_dir() else (path,))]
    return sum(each.st_size for each in states), max((s.st_mtime_ns for s in states), default=0)


def require_settled(states: Mapping[Path, tuple[int, int]], what: str) -> None:
    """Raise InputError for files whose `file_state` changed since, or changes a moment later."""
    newest = max(modified for _, modified in states.values()) / 1e9
    wait = newest + SETTLE_SECONDS - time.time()
    if wait > 0:
        # A time in the future, of a clock that runs ahead, tells nothing about the other files.
        time.sleep(min(wait, SETTLE_SECONDS))
    for path, state in states.items():
        try:
            same = file_state(path) == state
        except OSError:
            same = False
        if not same:
            todo = f"Wait until it is complete, then {what}."
            raise InputError(str(path), "a finished file", "one that is still being written", todo)
