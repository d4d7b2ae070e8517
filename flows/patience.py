"""Reads of a match whose disk is slow, or does not answer: they leave the others in peace."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import psutil

T = TypeVar("T")

SILENT_SECONDS: Final = 10.0
"""A disk that has not answered for so long is silent."""
SHORT_SECONDS: Final = 1.0
"""Wait of the impatient while another disk is silent: many matches can be on it."""
MOST_SILENT: Final = 64  # then the impatient begin no other read
MOST_OF_DISK: Final = 8  # silent reads of one disk: then no other one waits for it


@dataclass
class _Late(Generic[T]):
    """A read in a thread of its own."""

    mark: object
    known: list[T]
    """Results found so far, the best last."""
    made: Future[T] = field(default_factory=Future)
    clock: Callable[[], float] | None = None
    """Processor time of its thread [s]: it stands still while the disk does not answer."""
    spent: float = 0.0
    disk: str = ""
    """Where its disk is mounted, as far as it is known."""
    is_left: bool = False
    """Whether it ended because too many reads wait for its disk already."""
    moved_at: float = field(default_factory=time.monotonic)

    def run(self, read: Callable[[list[T]], T]) -> None:
        self.clock, _HERE.late = clock_of_this_thread(), self
        try:
            self.made.set_result(read(self.known))
        except SilentDiskError:
            self.is_left = True
            self.made.set_result(self.known[-1])
        except Exception as error:
            self.made.set_exception(error)

    def is_silent(self) -> bool:
        """Return whether its disk has not answered for `SILENT_SECONDS`, as far as was looked."""
        with suppress(OSError):  # the thread has just ended
            if self.clock is not None and self.spent != (spent := self.clock()):
                self.spent, self.moved_at = spent, time.monotonic()
        return not self.made.done() and time.monotonic() - self.moved_at >= SILENT_SECONDS


LATE: Final[dict[str, _Late[Any]]] = {}
_LOCK: Final = threading.Lock()
_HERE: Final = threading.local()


class SilentDiskError(Exception):
    """A disk that is needed does not answer, or too many reads wait for it already."""


def read_in_time(
    place: str, mark: object, read: Callable[[list[T]], T], first: T, *, is_patient: bool
) -> tuple[T, bool]:
    """Return what a read gives, or else the best that it has found, and whether its disk is silent.

    Only one read of a place is at work; one that began before another is not of its state, `mark`.
    `read` gets a list to which it adds what it finds on the way, `first` is what is known before.
    Who is patient waits for a slow disk.
    """
    with _LOCK:
        silent = sum(each.is_silent() for each in LATE.values())
        if (late := LATE.get(place)) is None:
            if silent >= MOST_SILENT and not is_patient:
                return first, False
            late = _Late(mark, [first])
            threading.Thread(target=late.run, args=[read], daemon=True).start()
            LATE[place] = late
    end = time.monotonic() + (SHORT_SECONDS if silent else SILENT_SECONDS)
    while not late.made.done() and not late.is_silent() and (is_patient or time.monotonic() < end):
        wait([late.made], SHORT_SECONDS)
    if not late.made.done():
        return late.known[-1], late.is_silent()
    with _LOCK:
        if LATE.get(place) is late:
            del LATE[place]
    if late.mark != mark:
        return read_in_time(place, mark, read, first, is_patient=is_patient)
    return late.made.result(), late.is_left


async def ask_disk(place: str, read: Callable[[], T]) -> T:
    """Return what a read gives, or raise SilentDiskError: no loop or thread of a server waits."""
    late = _Late[T](None, [])
    with _LOCK:
        asked = _ASKED[place] = [it for it in _ASKED.get(place, ()) if not it.made.done()]
        if len(asked) >= MOST_SILENT or any(each.is_silent() for each in asked):
            raise SilentDiskError
        asked.append(late)
    threading.Thread(target=late.run, args=[lambda _: read()], daemon=True).start()
    await asyncio.wait([asyncio.wrap_future(late.made)], timeout=SILENT_SECONDS)
    if not late.made.done():
        raise SilentDiskError
    return late.made.result()


_ASKED: Final[dict[str, list[_Late[Any]]]] = {}


def reach(path: str) -> None:
    """Note in a read that it now asks the disk of a path; end it if many reads wait for that."""
    if (late := getattr(_HERE, "late", None)) is None:
        return
    mounts = (each.mountpoint for each in psutil.disk_partitions(all=True))  # it asks no disk
    late.disk = max(filter(Path(path).is_relative_to, mounts), key=len, default="")
    with _LOCK:
        silent = sum(each.disk == late.disk and each.is_silent() for each in LATE.values())
    if silent >= MOST_OF_DISK:
        raise SilentDiskError


def clock_of_this_thread() -> Callable[[], float]:
    """Return a clock of the processor time of the calling thread [s], for other threads."""
    if hasattr(time, "pthread_getcpuclockid"):
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return lambda: time.clock_gettime(clock)
    return time.process_time  # macOS: of all threads
