"""Reads of a match whose disk is slow, or does not answer: they leave the others in peace."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

T = TypeVar("T")

SILENT_SECONDS: Final = 10.0
"""A disk that has not answered for so long is silent."""
SHORT_SECONDS: Final = 1.0
"""Wait of the impatient while another disk is silent: many matches can be on it."""


@dataclass
class _Late(Generic[T]):
    """A read in a thread of its own."""

    known: list[T]
    """What it has found, the best last."""
    made: Future[T] = field(default_factory=Future)
    clock: Callable[[], float] | None = None
    """Processor time of its thread [s]: it stands still while the disk does not answer."""
    spent: float = 0.0
    moved_at: float = field(default_factory=time.monotonic)

    def run(self, read: Callable[[list[T]], T]) -> None:
        self.clock = clock_of_this_thread()
        try:
            self.made.set_result(read(self.known))
        except Exception as error:
            self.made.set_exception(error)

    def is_silent(self) -> bool:
        """Return whether its disk has not answered for `SILENT_SECONDS`, as far as was looked."""
        with suppress(OSError):  # the thread has just ended
            spent = 0.0 if self.clock is None else self.clock()
            if spent != self.spent:
                self.spent, self.moved_at = spent, time.monotonic()
        return not self.made.done() and time.monotonic() - self.moved_at >= SILENT_SECONDS


_LATE: Final[dict[object, _Late[Any]]] = {}
_LOCK: Final = threading.Lock()


def read_in_time(
    place: object, read: Callable[[list[T]], T], first: T, *, is_patient: bool
) -> tuple[T, bool]:
    """Return what a read gives, or else the best that it has found, and whether its disk is silent.

    Args:
        place: what is read; of two reads of it, a second one does not begin while one is late.
        read: gets a list to which it adds what it finds on the way.
        first: what is known before.
        is_patient: wait for a disk that is slow.
    """
    with _LOCK:
        is_short = any(each.is_silent() for each in _LATE.values())
        late = _LATE.get(place)
        if late is None:
            late = _Late([first])
            threading.Thread(target=late.run, args=[read], daemon=True).start()
            _LATE[place] = late
    seconds = SHORT_SECONDS if is_short else SILENT_SECONDS
    end = math.inf if is_patient else time.monotonic() + seconds
    while not (is_silent := late.is_silent()) and time.monotonic() < end:
        if wait([late.made], SHORT_SECONDS).done:
            break
    if not late.made.done():
        return late.known[-1], is_silent
    with _LOCK:
        if _LATE.get(place) is late:
            del _LATE[place]
    return late.made.result(), False


def clock_of_this_thread() -> Callable[[], float]:
    """Return a clock of the processor time of the calling thread [s], for other threads."""
    if hasattr(time, "pthread_getcpuclockid"):
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return lambda: time.clock_gettime(clock)
    return time.process_time  # macOS: of all threads
