"""Inbox scan: which arrivals are complete, and which are invalid.

The inbox is never modified: a match stays at its place of arrival, and its known state is kept in
the project.
"""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any, Final

from data_contracts.operations import Arrival, ArrivalState, Priority
from flows.layers import PROJECT, read_layer
from flows.registering import register
from flows.service.layout import PRIORITIES, StateFolder
from flows.stage import Match
from worldpose.errors import InputError, InternalError, StoreError, WorldposeError
from worldpose.formats.files import read_yaml, sha256_of_file
from worldpose.ingest.match_folder import unclicked_clips
from worldpose.ingest.validation import require_local
from worldpose.store.store import Store

SUMS: Final = "SHA256SUMS"
"""An optional checksum list in the format of `sha256sum`, of all files to expect."""
MOST_FILES: Final = 2_000_000
"""Images of eighteen cameras for an hour in image folders; more is refused."""
LONGEST_SUMS: Final = 1 << 28
"""Size of a list of `MOST_FILES` names [byte]."""


@dataclass(frozen=True)
class Entry:
    """One entry of the inbox.

    The name is the path below the inbox; the containing folder states the priority.
    """

    path: Path
    name: str
    priority: Priority


class RefusalError(Exception):
    """An arrival cannot be a match in its present form."""


def entries(inbox: Path) -> Iterator[Entry]:
    """Yield all arrivals in the inbox, except names that begin with a dot: incomplete uploads."""
    for priority in PRIORITIES:
        if priority != "normal":
            folder = inbox / priority
            if folder.is_dir() and not folder.is_symlink() and not _is_match(folder):
                yield from _entries(folder, f"{priority}/", priority)
    for entry in _entries(inbox, "", "normal"):
        is_queue = entry.name in PRIORITIES and entry.path.is_dir() and not entry.path.is_symlink()
        if not is_queue or _is_match(entry.path):
            yield entry


def fingerprint_of(path: Path) -> str:
    """Return a digest of the names, sizes and times of all files of an arrival.

    RefusalError if the arrival is not a folder, or has a link, a special file, or an unsafe name;
    OSError if it is not readable, or changed in between.
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
                    # Without the time of the inode: a link to the file, as in a draft, changes it.
                    times = f"{status.st_ino} {status.st_size} {status.st_mtime_ns}"
                    lines.append(f"{where}\n{times}")
                if len(lines) > MOST_FILES:
                    raise RefusalError(f"more than {MOST_FILES} files")
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()


def missing_of(path: Path) -> str:
    """Describe the missing parts of a quiet arrival; empty if it is complete.

    RefusalError if its checksum list is malformed.
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
        if sha256_of_file(file) != digest:
            return f"{name} is not as {SUMS} says"
    return ""


def change_state(arrival: Arrival, state: ArrivalState, reason: str, **more: Any) -> Arrival:  # noqa: ANN401
    """Return the arrival in another state, or with other fields; the time is that of the state."""
    is_news = (arrival.state, arrival.reason) != (state, reason)
    changed_at = datetime.now(UTC) if is_news else arrival.changed_at
    update = {"state": state, "reason": reason, "changed_at": changed_at, **more}
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
            yield Entry(path, prefix + printable(path.name), priority)


def printable(name: str) -> str:
    """Return a name with its backslashes, control characters and undecodable bytes escaped."""
    return "".join(
        each if each.isprintable() and each != "\\" else ascii(each)[1:-1] for each in name
    )


def _is_match(folder: Path) -> bool:
    return (folder / "match.yaml").is_file()


def match_id_in(file: Path) -> str | None:
    """Return the id that a match.yaml states; None if it is unreadable or states none."""
    try:
        status = file.lstat()
        if not stat.S_ISREG(status.st_mode):
            return None
        return _read_match_id(file, status.st_mtime_ns, status.st_ino)
    except (OSError, WorldposeError):
        return None


@lru_cache(maxsize=10_000)
def _read_match_id(file: Path, changed_ns: int, number: int) -> str | None:
    content = read_yaml(file)
    found = content.get("match_id") if isinstance(content, dict) else None
    return found if isinstance(found, str) else None


def _require_plain(name: str) -> None:
    if not name.isprintable() or "\\" in name:  # lone surrogates stand for bytes that are not UTF-8
        raise RefusalError(f"the name {name!a} has characters that names here may not have")


MAX_DEATHS: Final = 2
"""Processes that end during the intake of an arrival before it is refused."""

Begin = Callable[[Match, Arrival], str]
"""Starts a match's run, only once however often it is called; returns the run's Prefect id."""


REPLACES: Final = ".replaces"
"""File in the next version of a match: its inode, and the folder that it replaces.

It moves with the folder: neither a kill nor a scan in between loses the fact.
"""


def put_in(
    state: StateFolder,
    inbox: Path,
    folder: Path,
    name: str,
    priority: Priority = "normal",
    replaces: str | None = None,
    corrects: str | None = None,
) -> None:
    """Move a whole match folder into the inbox in one step.

    The inbox, in which `name` is a path, is on the disk of the folder. `replaces` is the folder of
    the registered match whose next version it is, `corrects` that of a refused arrival whose place
    it takes. InputError if another next version is on its way, or that arrival was taken in
    meanwhile.
    """
    target = inbox / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if replaces is not None:
        (folder / REPLACES).write_text(f"{folder.stat().st_ino} {replaces}", encoding="utf-8")
    fingerprint = ""  # what cannot be taken in is refused by the next scan
    with suppress(RefusalError):
        fingerprint = fingerprint_of(folder)
    with state.only_one("versions", wait=True):
        on_the_way = [it for it in state.arrivals().values() if it.state != "taken"]
        for each in on_the_way if replaces is not None else ():
            if each.replaces == replaces and str((inbox / each.name).resolve()) != corrects:
                raise InputError(
                    name,
                    expected="no other new files of this match on their way",
                    found=f"{each.name}, {each.state}",
                    todo="Wait until they are taken in, or remove them in the list of matches.",
                )
        for old in [it.name for it in entries(inbox) if str(it.path.resolve()) == corrects]:
            remove_entry(state, inbox, old)
        folder.rename(target)
        # No scan has to see that nothing of it changes.
        with suppress(WorldposeError, OSError):
            arrival = Arrival(
                name=name,
                state="arriving",
                priority=priority,
                fingerprint=fingerprint,
                replaces=replaces,
                changed_at=datetime.now(UTC),
            )
            state.write_arrival(arrival)


def _replaced_by(path: Path) -> str | None:
    """Return the folder that the next version of a match replaces; None for a copy of it."""
    with suppress(OSError, ValueError):
        number, _, replaces = (path / REPLACES).read_text(encoding="utf-8").partition(" ")
        return replaces if number == str(path.stat().st_ino) else None
    return None


def next_version(inbox: Path, name: str) -> str:
    """Return the path in the inbox of the next version of a match."""
    versions = (f"{name}.v{number}" for number in count(2))
    return next(each for each in versions if not (inbox / each).exists())


REMOVED: Final = ".removed"
"""Folder of the inbox for what people removed; no scan looks into it."""


def set_aside(inbox: Path, path: Path) -> Path:
    """Move an entry out of the sight of scans, and return its new place; nothing is deleted."""
    target = inbox / REMOVED / f"{datetime.now(UTC):%Y%m%d-%H%M%S-%f}-{path.name}"
    target.parent.mkdir(exist_ok=True)
    return path.rename(target)


def find_refused(state: StateFolder, inbox: Path, name: str) -> tuple[Entry, Arrival]:
    """Return an entry of the inbox that was not taken in, with what was found of it.

    InputError if there is none of this name: it was taken in or removed meanwhile.
    """
    found = state.arrivals().get(name)
    for entry in entries(inbox):
        if entry.name == name and found is not None and found.state in ("refused", "incomplete"):
            return entry, found
    todo = "Load the list of matches again."
    raise InputError(name, "an arrival that was refused", "none any more", todo)


def try_again(state: StateFolder, inbox: Path, name: str) -> None:
    """Let the next scan take in a refused entry as if it had just come."""
    _, arrival = find_refused(state, inbox, name)
    again = {"fingerprint": "", "deaths": 0}
    state.write_arrival(change_state(arrival, "arriving", "is tried again", **again))


def remove_entry(state: StateFolder, inbox: Path, name: str) -> Path:
    """Take a refused entry out of the inbox; return where its files are now."""
    entry, _ = find_refused(state, inbox, name)
    moved = set_aside(inbox, entry.path)
    state.forget_arrival(name)
    return moved


def run_key(match: Match, arrival: Arrival) -> str:
    """Return the key of the run that an arrival begins, once however often it is taken in.

    The next version of a match can have the videos, detections and pitch of the one before.
    """
    version = f"-{arrival.fingerprint}" if arrival.replaces else ""
    return f"arrival-{match.registration.identity}{version}"


def watch_once(state: StateFolder, inbox: Path, quiet: float) -> list[str]:
    """Scan the inbox, save its state, and return the names of complete arrivals.

    An arrival is complete after `quiet` seconds without changes.
    """
    with state.only_one("arrivals", wait=False) as is_held:
        ready = _scan(state, inbox, quiet) if is_held else []
    return [f"{each.name} {each.fingerprint} {each.deaths}" for _, each in ready]


def take_in(
    store: Store, state: StateFolder, inbox: Path, quiet: float, begin: Begin
) -> list[Arrival]:
    """Register every complete arrival; return all arrivals with a decision.

    A call after a kill registers nothing twice and starts no second run. An arrival whose intake
    ended the process (out of memory, a crash) is processed last at the next attempt, and is refused
    after `MAX_DEATHS`. `begin` starts a match's run.
    """
    decided = []
    read_layer(store, PROJECT)  # the project is at fault, and no arrival is refused for it
    with state.only_one("arrivals", wait=True):
        ready = _scan(state, inbox, quiet)
        for entry, arrival in sorted(ready, key=lambda each: each[1].deaths):
            result = _take(store, state, entry, arrival, begin)
            state.write_arrival(result)
            decided.append(result)
    return decided


def _take(
    store: Store, state: StateFolder, entry: Entry, arrival: Arrival, begin: Begin
) -> Arrival:
    """Register one arrival; a note written first tells the next process if this one dies."""
    if arrival.deaths >= MAX_DEATHS:
        return change_state(
            arrival,
            "refused",
            f"the process that took it in died {arrival.deaths} times, killed or by a crash: the "
            "system's log says which (out of memory?). It is tried again when a file of it changes",
        )
    again = f", try {arrival.deaths + 1}" if arrival.deaths else ""
    state.write_arrival(change_state(arrival, "arriving", f"being taken in{again}", is_begun=True))
    try:
        return _decide(store, entry, arrival, begin)
    except BaseException:
        state.write_arrival(arrival)  # an exception or a signal does not count as a death
        raise


def _scan(state: StateFolder, inbox: Path, quiet: float) -> list[tuple[Entry, Arrival]]:
    """Save the state of the inbox, and return the entries to take in; the caller holds the lock."""
    known, names, ready = state.arrivals(), set(), []
    for entry in entries(inbox):
        names.add(entry.name)
        before = known.get(entry.name)
        if before is not None and before.state == "taken":
            # Only another id tells another match: people go on clicking in a folder taken in.
            if match_id_in(entry.path / "match.yaml") in (None, before.match_id):
                continue
            before = None
        arrival, is_ready = _look_at(entry, before, quiet)
        if arrival != before:
            state.write_arrival(arrival)
        if is_ready:
            ready.append((entry, arrival))
    for name, before in known.items():
        if before.state != "taken" and name not in names:
            state.forget_arrival(name)
    return ready


def _look_at(entry: Entry, before: Arrival | None, quiet: float) -> tuple[Arrival, bool]:
    """Return the state of an entry now, and whether to take it in.

    It is complete when nothing changed for `quiet` seconds. A refused or incomplete arrival is
    checked again after a change.
    """
    arrival = before or Arrival(
        name=entry.name, state="arriving", priority=entry.priority, changed_at=datetime.now(UTC)
    )
    try:
        fingerprint = fingerprint_of(entry.path)
    except RefusalError as refusal:
        return change_state(arrival, "refused", str(refusal), fingerprint=""), False
    except OSError as error:  # it changes during the scan, or is not readable
        reason = f"cannot be read: {error.strerror}"
        return change_state(arrival, "incomplete", reason, fingerprint=""), False
    if arrival.replaces is None:
        arrival = arrival.model_copy(update={"replaces": _replaced_by(entry.path)})
    is_same = arrival.fingerprint == fingerprint
    if is_same and arrival.state in ("refused", "incomplete"):
        return arrival, False
    now = time.monotonic()
    # The clock restarts at a reboot: then the quiet time starts again.
    since = min(arrival.unchanged_since, now) if is_same else now
    # We hold the lock, so a process that began an intake is dead.
    deaths = arrival.deaths + arrival.is_begun if is_same else 0
    reason = f"taken in when nothing of it has changed for {quiet:g} s"
    is_ready = is_same and now - since >= quiet
    if is_ready:
        reason = "being taken in"
    if deaths:
        times = f"{deaths} time{'s' if deaths > 1 else ''}"
        reason += f"; the process that took it in died {times}"
    update = {"unchanged_since": since, "deaths": deaths, "is_begun": False}
    arrival = change_state(arrival, "arriving", reason, fingerprint=fingerprint, **update)
    return arrival, is_ready


def _decide(store: Store, entry: Entry, arrival: Arrival, begin: Begin) -> Arrival:
    """Register one arrival, or return the reason against it; errors do not affect others."""
    try:
        missing = missing_of(entry.path)
        if missing:
            return change_state(arrival, "incomplete", missing)
        path, replaces = entry.path.resolve(), arrival.replaces
        match, _ = register(store, path, unfinished=True, replaces=replaces)
    except StoreError:
        raise  # the project is at fault, not the arrival
    except (RefusalError, WorldposeError) as refusal:
        return change_state(arrival, "refused", str(refusal))
    except OSError as error:
        reason = f"{error.filename}: {error.strerror}"  # tried again, though nothing changes
        return change_state(arrival, "incomplete", reason, fingerprint="")
    except Exception as error:  # an unforeseen error; nothing was registered
        return change_state(arrival, "refused", str(InternalError.wrap(arrival.name, error)))
    unclicked = [*match.folder.to_click, *unclicked_clips(match.folder)]
    if unclicked:
        reason = f"to be clicked on the review pages first: {', '.join(unclicked)}"
        return change_state(arrival, "taken", reason, match_id=match.match_id)
    run = begin(match, arrival)
    return change_state(arrival, "taken", "", match_id=match.match_id, flow_run=run)
