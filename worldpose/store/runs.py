"""Runs of a project: their numbers, reservations, records, pins and locks.

A pin is a name of a run, and garbage collection keeps every pinned run.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from data_contracts.pin import Pin
from data_contracts.run import Reservation
from worldpose.errors import CorruptionError, InputError
from worldpose.store.blobs import Blobs
from worldpose.store.documents import R, seal, unseal
from worldpose.store.paths import checked_name, is_name, pin_path


def pin_run(blobs: Blobs, pin: Pin) -> Pin:
    """Pin a run under a name; return the pin in force.

    Pinning the same run under the same name again changes nothing. InputError if the name is a
    number or `latest`, or is another run's.
    """
    if pin.name == "latest" or pin.name.isdigit():
        raise InputError(
            f"name of run {pin.run_id} of {pin.match_id}",
            expected="a name that is neither a number nor 'latest'",
            found=repr(pin.name),
            todo="Choose a name with a letter, such as v1.",
        )
    if blobs.put_new(pin_path(pin.match_id, pin.name), seal(pin)):
        return pin
    known = read_pin(blobs, pin.match_id, pin.name)
    if known is None or known.run_id != pin.run_id:
        raise InputError(
            f"name {pin.name} of a run of {pin.match_id}",
            expected="a name that no other run has",
            found=(
                "a pin that was removed at the same time"
                if known is None
                else f"run {known.run_id} pinned under this name"
            ),
            todo="Choose another name, or unpin that run first.",
        )
    return known


def unpin_run(blobs: Blobs, match_id: str, name: str) -> Pin:
    """Remove a pin, so that its run can be forgotten; return it. InputError if there is none."""
    pin = read_pin(blobs, match_id, name)
    if pin is None:
        names = ", ".join(known.name for known in list_pins(blobs, match_id))
        raise InputError(
            f"pin {match_id}/{name}",
            expected=f"one of {names or '(none)'}",
            found="no such name",
            todo="List them with `worldpose status`.",
        )
    blobs.delete(pin_path(match_id, name))
    return pin


def read_pin(blobs: Blobs, match_id: str, name: str) -> Pin | None:
    """Return the pin of a name, None if no run has it."""
    return read_document(blobs, pin_path(match_id, name), Pin)


def read_document(blobs: Blobs, path: str, kind: type[R]) -> R | None:
    """Return the record at a path; None if there is none.

    CorruptionError, with how to repair it, if it is damaged, InputError if of another version.
    """
    data = blobs.read(path)
    try:
        return None if data is None else unseal(kind, data, f"{blobs.url}/{path}")
    except CorruptionError as error:
        raise CorruptionError(
            f"{error}. Restore it from a copy, or let `worldpose verify --repair` set it aside."
        ) from error


def list_pins(blobs: Blobs, match_id: str) -> tuple[Pin, ...]:
    """Return all of a match's pins, sorted by name."""
    files = [entry.path.rpartition("/")[2] for entry in blobs.entries(f"pins/{match_id}")]
    names = [file.removesuffix(".json") for file in files if file.endswith(".json")]
    pins = (read_pin(blobs, match_id, name) for name in names if is_name(name))
    return tuple(pin for pin in pins if pin is not None)


@contextmanager
def alone(blobs: Blobs, what: str, *, wait: bool) -> Iterator[bool]:
    """Hold the lock `what` of a project; yield whether it was acquired, as `hold_lock`.

    Processes exclude each other that can write the project's folder `locks`: on one machine, or on
    several where the file system shares its locks. Where there is none, as in object storage, those
    of one user and machine do, by a lock in the folder of temporary files.
    """
    mine = Path(tempfile.gettempdir(), f"worldpose-{os.getuid()}")
    places = [mine / hashlib.sha256(blobs.url.encode()).hexdigest()[:16]]
    with suppress(OSError):
        mine.mkdir(mode=0o700, exist_ok=True)
        places[0].mkdir(exist_ok=True)
    if "://" not in blobs.url:
        places.insert(0, Path(blobs.url, "locks"))
    with ExitStack() as stack:
        for place in places:
            try:
                is_held = stack.enter_context(hold_lock(place / f"{what}.lock", wait=wait))
                break
            except OSError:
                if place is places[-1]:
                    raise
        yield is_held


@contextmanager
def hold_lock(file: Path, *, wait: bool, most_seconds: float = 600.0) -> Iterator[bool]:
    """Hold the lock of a file; yield whether it was acquired, which can fail without `wait`.

    The operating system releases the lock when the process ends, however it ends. The parent of the
    lock's folder must exist, and not be empty: there a project's disk may not be mounted.
    InputError if another process has held it for `most_seconds` [s] of waiting.
    """
    end = time.monotonic() + most_seconds
    if not file.parent.exists() and any(file.parent.parent.iterdir()):
        file.parent.mkdir(exist_ok=True)
    is_of_other = file.exists() and not os.access(file, os.W_OK)  # another user's
    with file.open("r" if is_of_other else "a") as lock:
        while not (is_held := _try_lock(lock)) and wait:
            time.sleep(0.05)  # unlike one long wait, it shows that this process is well
            if time.monotonic() > end:
                raise InputError(
                    str(file),
                    expected=f"a lock that is free within {most_seconds / 60.0:g} min",
                    found="another process that holds it",
                    todo="Look after its disk, or end that process; then try again.",
                )
        yield is_held


def _try_lock(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


LATEST = "latest"

_FILE = re.compile(r"(\d+)(\.open)?\.json(\.damaged)?")
"""Name of a run's record or reservation, in use or set aside; other files are foreign."""


def may_be_running(reservation: Reservation) -> bool:
    """Return whether the run's process may be active; True for a process on another machine."""
    if reservation.host != platform.node():
        return True
    try:
        os.kill(reservation.pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def is_run_file(name: str) -> bool:
    """Return whether `name` is the file name of a run's record or reservation."""
    return _FILE.fullmatch(name) is not None


def run_files(blobs: Blobs, match_id: str) -> tuple[set[str], set[str], set[str]]:
    """Return the runs of a match with a record, with a reservation, and with one set aside."""
    top = f"runs/{checked_name(match_id)}"
    finished: set[str] = set()
    reserved: set[str] = set()
    damaged: set[str] = set()
    for entry in blobs.entries(top):
        found = _FILE.fullmatch(entry.path.removeprefix(f"{top}/"))
        if found is not None:
            run_id, is_reservation, is_damaged = found.groups()
            kind = damaged if is_damaged else reserved if is_reservation else finished
            kind.add(run_id)
    return finished, reserved, damaged


def begin_run(match_id: str, run_id: str) -> Reservation:
    """Return the reservation of a run that this process begins now."""
    return Reservation(
        run_id=run_id,
        match_id=match_id,
        started_at=datetime.now(UTC),
        host=platform.node(),
        pid=os.getpid(),
        process=identify_process(os.getpid()),
    )


def identify_process(pid: int) -> str:
    """Return the machine's boot and a process's start since then; empty where neither is told.

    Unlike the time of its start, they do not change with the clock.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        told = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return ""
    return f"{boot} {told.rpartition(')')[2].split()[19]}"  # the name before it can have anything


def run_order(run_id: str) -> tuple[int, str]:
    """Return a sort key that orders run ids by number."""
    return (int(run_id) if run_id.isascii() and run_id.isdigit() else 0, run_id)
