"""Inbox scan: which arrivals are complete, and which are invalid.

The inbox is never modified: a match stays at its place of arrival, and its known state is kept in
the project.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from data_contracts.operations import Arrival, ArrivalState, Priority
from flows.service.layout import PRIORITIES
from worldpose.errors import InputError
from worldpose.ingest.validation import require_local

SUMS: Final = "SHA256SUMS"
"""An optional checksum list in the format of `sha256sum`, of all files to expect."""
MOST_FILES: Final = 2_000_000
"""Images of eighteen cameras for an hour in image folders; more is refused."""
LONGEST_SUMS: Final = 1 << 28
"""Size of a list of `MOST_FILES` names [byte]."""


@dataclass(frozen=True)
class Entry:
    """One entry of the inbox.

    Attributes:
        path: its path.
        name: path below the inbox for display and storage.
        priority: from the folder that contains it.
    """

    path: Path
    name: str
    priority: Priority


class RefusalError(Exception):
    """An arrival cannot be a match in its present form."""


def entries(inbox: Path) -> Iterator[Entry]:
    """Yield all arrivals in the inbox; a dot before a name marks an upload in progress."""
    for priority in PRIORITIES:
        if priority != "normal":
            folder = inbox / priority
            if folder.is_dir() and not folder.is_symlink() and not _is_match(folder):
                yield from _entries(folder, f"{priority}/", priority)
    for entry in _entries(inbox, "", "normal"):
        is_queue = entry.name in PRIORITIES and entry.path.is_dir() and not entry.path.is_symlink()
        if not is_queue or _is_match(entry.path):
            yield entry


def look(
    inbox: Path, known: Mapping[str, Arrival], *, now: float, quiet: float
) -> list[tuple[Entry, Arrival, bool]]:
    """Return each arrival that is not taken yet, its state now, and whether to take it in.

    The caller must hold the lock of the arrivals.

    It is complete when match.yaml is there and nothing changed for `quiet` seconds. A refused or
    incomplete arrival is checked again after a change.

    Args:
        inbox: the folder.
        known: previous states, by name.
        now: time on the machine's monotonic clock [s].
        quiet: required time without changes [s].
    """
    found = []
    for entry in entries(inbox):
        before = known.get(entry.name)
        if before is not None and before.state == "taken":
            continue
        try:
            fingerprint = fingerprint_of(entry.path)
        except RefusalError as refusal:
            found.append((entry, _changed(entry, before, "refused", str(refusal)), False))
            continue
        except OSError as error:  # it changes during the scan, or is not readable
            reason = f"cannot be read: {error.strerror}"
            found.append((entry, _changed(entry, before, "incomplete", reason), False))
            continue
        is_same = before is not None and before.fingerprint == fingerprint
        # We hold the lock, so a process that began an intake is dead.
        deaths = before.deaths + before.is_begun if before is not None and is_same else 0
        # The clock restarts at a reboot: then the quiet time starts again.
        since = before.unchanged_since if before is not None and is_same else now
        since = min(since, now)
        if is_same and before is not None and before.state in ("refused", "incomplete"):
            found.append((entry, before, False))
            continue
        arrival = _changed(
            entry,
            before,
            "arriving",
            f"taken in when nothing of it has changed for {quiet:g} s{_died(deaths)}",
            fingerprint=fingerprint,
            unchanged_since=since,
            deaths=deaths,
        )
        found.append((entry, arrival, is_same and now - since >= quiet))
    return found


def fingerprint_of(path: Path) -> str:
    """Return a digest of the names, sizes and times of all files of an arrival.

    Raises:
        RefusalError: it is not a folder, or has a link, a special file, or an unsafe name.
        OSError: it is not readable, or changed in between.
    """
    _require_plain(path.name)
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        raise RefusalError("it is a link; a match is a folder in the inbox itself")
    if not stat.S_ISDIR(mode):
        raise RefusalError("it is a file; a match is a folder with a match.yaml")
    lines = []
    folders = [path]
    while folders:
        folder = folders.pop()
        with os.scandir(folder) as inside:
            for each in inside:
                _require_plain(each.name)
                where = os.path.relpath(each.path, path)
                status = each.stat(follow_symlinks=False)
                if stat.S_ISLNK(status.st_mode):
                    raise RefusalError(f"{where} is a link; a match holds its files itself")
                if stat.S_ISDIR(status.st_mode):
                    folders.append(Path(each.path))
                elif not stat.S_ISREG(status.st_mode):
                    raise RefusalError(f"{where} is neither a file nor a folder")
                else:
                    times = (status.st_mtime_ns, status.st_ctime_ns)
                    lines.append(f"{where}\n{status.st_ino} {status.st_size} {times}")
                if len(lines) > MOST_FILES:
                    raise RefusalError(f"more than {MOST_FILES} files")
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()


def missing_of(path: Path) -> str:
    """Describe the missing parts of a quiet arrival; empty if it is complete.

    Raises:
        RefusalError: its checksum list is malformed.
    """
    if not _is_match(path):
        return "match.yaml is not there"
    sums = path / SUMS
    if not sums.is_file():
        return ""
    for name, digest in _sums(sums):
        file = path / name
        if not file.is_file():
            return f"{name} of {SUMS} is not there"
        with file.open("rb") as content:
            if hashlib.file_digest(content, "sha256").hexdigest() != digest:
                return f"{name} is not as {SUMS} says"
    return ""


def changed(
    arrival: Arrival, state: ArrivalState, reason: str, **more: str | bool | None
) -> Arrival:
    """Return the arrival in another state."""
    update = {"state": state, "reason": reason, "changed_at": datetime.now(UTC), **more}
    return arrival.model_copy(update=update)


def _sums(file: Path) -> Iterator[tuple[str, str]]:
    if file.stat().st_size > LONGEST_SUMS:
        raise RefusalError(f"{SUMS} is longer than {LONGEST_SUMS} bytes")
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise RefusalError(f"{SUMS} is not text") from None
    for number, line in enumerate(filter(str.strip, lines), 1):
        digest, _, name = line.partition(" ")
        name = name[1:] if name[:1] in (" ", "*") else name
        name = name.removeprefix("./")
        is_digest = len(digest) == 64 and not set(digest.lower()) - set("0123456789abcdef")
        if not is_digest or not name:
            raise RefusalError(f"line {number} of {SUMS} is not as sha256sum writes it")
        try:
            require_local(name, SUMS)
        except InputError as error:
            raise RefusalError(str(error)) from None
        yield name, digest.lower()


def _entries(folder: Path, prefix: str, priority: Priority) -> Iterator[Entry]:
    for path in sorted(folder.iterdir()):
        if not path.name.startswith("."):
            yield Entry(path, prefix + _shown(path.name), priority)


def _is_match(folder: Path) -> bool:
    return (folder / "match.yaml").is_file()


def _shown(name: str) -> str:
    return ascii(name)[1:-1]


def _require_plain(name: str) -> None:
    if not name.isprintable() or "\\" in name:  # lone surrogates stand for bytes that are not UTF-8
        raise RefusalError(f"the name {name!a} has characters that names here may not have")


def _died(deaths: int) -> str:
    if deaths == 0:
        return ""
    return f"; the process that took it in died {deaths} time{'s' if deaths > 1 else ''}"


def _changed(
    entry: Entry,
    before: Arrival | None,
    state: ArrivalState,
    reason: str,
    *,
    fingerprint: str = "",
    unchanged_since: float = 0.0,
    deaths: int = 0,
) -> Arrival:
    arrival = Arrival(
        name=entry.name,
        state=state,
        reason=reason,
        priority=entry.priority,
        fingerprint=fingerprint,
        unchanged_since=unchanged_since,
        deaths=deaths,
        changed_at=datetime.now(UTC),
    )
    is_news = before is None or (before.state, before.reason) != (state, reason)
    if not is_news and before is not None:
        return arrival.model_copy(update={"changed_at": before.changed_at})
    return arrival
