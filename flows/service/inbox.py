"""What lies in the inbox: which arrivals are complete, and which can never be a match.

Nothing in the inbox is ever moved, changed or deleted: a match stays where it arrived, and what is
known of it lies in the project.
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
from worldpose.ingest.places import require_local

SUMS: Final = "SHA256SUMS"
"""An optional list, as `sha256sum` writes it, of all that has to have arrived."""
MOST_FILES: Final = 2_000_000
"""Eighteen cameras' pictures of an hour in folders of images; more is refused."""
LONGEST_SUMS: Final = 1 << 28
"""Bytes of a list of `MOST_FILES` names."""


@dataclass(frozen=True)
class Entry:
    """One entry of the inbox.

    Attributes:
        path: where it lies.
        name: path below the inbox as it is shown and kept.
        priority: by the folder that it lies in.
    """

    path: Path
    name: str
    priority: Priority


class RefusalError(Exception):
    """An arrival can never be a match as it is."""


def entries(inbox: Path) -> Iterator[Entry]:
    """All arrivals in the inbox; names that begin with a dot are of those who still write."""
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
    """Each arrival that is not taken yet, what is known of it now, and whether to take it in.

    Called by the one that holds the lock of the arrivals.

    It is complete when match.yaml is there and nothing of it has changed for `quiet` seconds.
    What was refused or incomplete is looked at again when it has changed.

    Args:
        inbox: the folder.
        known: what was known, by name.
        now: of the machine's clock that only goes forward [s].
        quiet: how long nothing may have changed [s].
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
        except OSError as error:  # it changes as we look, or may not be read
            reason = f"cannot be read: {error.strerror}"
            found.append((entry, _changed(entry, before, "incomplete", reason), False))
            continue
        is_same = before is not None and before.fingerprint == fingerprint
        # The lock is ours: what is begun was begun by a process that lives no more.
        deaths = before.deaths + before.is_begun if before is not None and is_same else 0
        # After a reboot that clock begins anew: then it is waited for once more.
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
    """Digest of the names, sizes and times of all files of an arrival.

    Raises:
        RefusalError: it is no folder, or has a link, a special file, or a name that is not plain.
        OSError: it cannot be read, or changed meanwhile.
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
    """What a quiet arrival lacks, in words; empty where it lacks nothing.

    Raises:
        RefusalError: its list of sums is none.
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
    """The arrival in another state."""
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
    if not name.isprintable() or "\\" in name:  # lone surrogates stand for what is no UTF-8
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
