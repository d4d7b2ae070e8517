"""Runs of a project: their numbers, reservations, records and pins.

A pin is a name of a run, and garbage collection keeps every pinned run.
"""

from __future__ import annotations

import os
import platform
import re
from datetime import UTC, datetime

from pydantic import JsonValue

from data_contracts.pin import Pin
from data_contracts.run import Reservation, RunRecord
from worldpose.errors import InputError, StoreError
from worldpose.store.blobs import Blobs, pass_commit_point
from worldpose.store.documents import R, seal, unseal_repairable
from worldpose.store.paths import checked_name, is_name, pin_path, record_path, reservation_path


def pin_run(blobs: Blobs, pin: Pin) -> Pin:
    """Pin a run under a name; return the pin in force.

    Pinning the same run under the same name again changes nothing.

    Raises:
        InputError: the name is a number or `latest`, or is another run's.
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
    """Remove a pin, so that its run can be forgotten; return it.

    Raises:
        InputError: there is no such name.
    """
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
    return _read(blobs, pin_path(match_id, name), Pin)


def _read(blobs: Blobs, path: str, kind: type[R]) -> R | None:
    """Return the record at a path; None if there is none."""
    data = blobs.read(path)
    return None if data is None else unseal_repairable(kind, data, f"{blobs.url}/{path}")


def list_pins(blobs: Blobs, match_id: str) -> tuple[Pin, ...]:
    """Return all of a match's pins, sorted by name."""
    files = [entry.path.rpartition("/")[2] for entry in blobs.entries(f"pins/{match_id}")]
    names = [file.removesuffix(".json") for file in files if file.endswith(".json")]
    pins = (read_pin(blobs, match_id, name) for name in names if is_name(name))
    return tuple(pin for pin in pins if pin is not None)


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


def list_runs(blobs: Blobs, match_id: str) -> tuple[list[str], list[str]]:
    """Return ids of a match's finished runs, and of those reserved but not finished, in order."""
    finished, reserved, _ = _files(blobs, match_id)
    return sorted(finished, key=run_order), sorted(reserved - finished, key=run_order)


def reserve_run(
    blobs: Blobs, match_id: str, overrides: dict[str, dict[str, JsonValue]] | None = None
) -> str:
    """Reserve a run number that no other run of the match has or gets: `0001`, `0002`, ...

    Args:
        blobs: the store's files.
        match_id: the match.
        overrides: stage to the requested settings, which outlast a killed run.
    """
    number = 0
    while True:
        # A record that was set aside keeps its number: reviews may name the run. A number that
        # could not be reserved, for any reason, is not tried again.
        taken = set[str]().union(*_files(blobs, match_id))
        number = max([number, *(run_order(name)[0] for name in taken)]) + 1
        run_id = f"{number:04d}"
        path = reservation_path(match_id, run_id)
        reservation = Reservation(
            run_id=run_id,
            match_id=match_id,
            started_at=datetime.now(UTC),
            host=platform.node(),
            pid=os.getpid(),
            overrides=overrides,
        )
        if not blobs.put_new(path, seal(reservation)):
            continue
        # Another run may have taken this number, finished and dropped its reservation in between.
        if not blobs.exists(record_path(match_id, run_id)):
            return run_id
        blobs.delete(path)


def read_reservation(blobs: Blobs, match_id: str, run_id: str) -> Reservation | None:
    """Return the reservation of a run; None if there is none, for example after its end."""
    return _read(blobs, reservation_path(match_id, run_id), Reservation)


def read_record(blobs: Blobs, match_id: str, run_id: str = LATEST) -> RunRecord:
    """Read the record of a finished run by number or name; `latest` has the highest number.

    Raises:
        InputError: there is no such run.
        CorruptionError: the record is damaged.
    """
    finished, reserved = list_runs(blobs, match_id)
    wanted = finished[-1] if run_id == LATEST and finished else run_id
    if wanted not in finished:
        pin = read_pin(blobs, match_id, run_id)
        wanted = run_id if pin is None else pin.run_id
    if wanted not in finished:
        raise InputError(
            f"run {run_id} of match {match_id} in {blobs.url}",
            expected=f"one of {', '.join(finished)}" if finished else "a finished run",
            found="an unfinished run" if run_id in reserved else "no such run",
            todo=f"Run: worldpose run {match_id}",
        )
    path = record_path(match_id, wanted)
    return unseal_repairable(RunRecord, blobs.read(path) or b"", f"{blobs.url}/{path}")


def write_record(blobs: Blobs, record: RunRecord) -> None:
    """Write a run's record, only once, and drop its reservation.

    Raises:
        StoreError: the run already has another record.
    """
    path, data = record_path(record.match_id, record.run_id), seal(record)
    pass_commit_point("before_run_record")
    if not blobs.put_new(path, data) and blobs.read(path) != data:
        raise StoreError(
            f"{blobs.url}/{path} exists with other content: run {record.run_id} of match "
            f"{record.match_id} was finished earlier. Reserve a new run."
        )
    pass_commit_point("after_run_record")
    blobs.delete(reservation_path(record.match_id, record.run_id))


def is_run_file(name: str) -> bool:
    """Return whether `name` is the file name of a run's record or reservation."""
    return _FILE.fullmatch(name) is not None


def _files(blobs: Blobs, match_id: str) -> tuple[set[str], set[str], set[str]]:
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


def run_order(run_id: str) -> tuple[int, str]:
    """Return a sort key that orders run ids by number."""
    return (int(run_id) if run_id.isascii() and run_id.isdigit() else 0, run_id)
