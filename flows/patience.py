"""Reads of a match whose disk is slow, or does not answer: they leave the others in peace."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Thread
from typing import Any, Final, Generic, TypeVar

T = TypeVar("T")

SILENT_SECONDS: Final = 10.0
"""A disk that has not answered for so long is silent."""
SHORT_SECONDS: Final = 1.0
"""The same while another read is late: many matches can be on one silent disk."""


@dataclass
class _Late(Generic[T]):
    """A read in a thread of its own."""

    known: list[T]
    """What it has found, the best last."""
    made: Future[T] = field(default_factory=Future)
    clock: Callable[[], float] | None = None
    """Processor time of its thread [s]: it stands still while the disk does not answer."""
    spent: float = -1.0
    moved_at: float = -math.inf

    def run(self, read: Callable[[list[T]], T]) -> None:
        self.clock = clock_of_this_thread()
        try:
            self.made.set_result(read(self.known))
        except Exception as error:
            self.made.set_exception(error)

    def is_slow(self) -> bool:
        """Return whether the disk has answered since the last call, or within `SILENT_SECONDS`."""
        with suppress(OSError):  # the thread has just ended
            spent = 0.0 if self.clock is None else self.clock()
            if spent != self.spent >= 0.0:
                self.moved_at = time.monotonic()
            self.spent = spent
        return time.monotonic() - self.moved_at < SILENT_SECONDS


_LATE: Final[dict[object, _Late[Any]]] = {}


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
    late = _LATE.get(place)
    if late is None or late.made.done():
        others = any(not each.made.done() for each in list(_LATE.values()))
        late = _Late([first])
        thread = Thread(target=late.run, args=[read], daemon=True)
        thread.start()
        thread.join(SHORT_SECONDS if others else SILENT_SECONDS)
        if late.made.done():
            return late.made.result(), False
        _LATE[place] = late
        late.is_slow()
        thread.join(SHORT_SECONDS)
    is_slow = late.is_slow()
    while is_slow and is_patient and not late.made.done():
        time.sleep(SHORT_SECONDS)
        is_slow = late.is_slow()
    if late.made.done():
        return late.made.result(), False
    return late.known[-1], not is_slow


def clock_of_this_thread() -> Callable[[], float]:
    """Return a clock of the processor time of the calling thread [s], for other threads."""
    if hasattr(time, "pthread_getcpuclockid"):
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return lambda: time.clock_gettime(clock)
    return time.process_time  # macOS: of all threads
