"""Limit on restarts of a unit: a unit that hangs or ends its worker's process is given up.

A hang or crash in a library cannot be caught: its process ends, Dask starts a new one and gives it
the unit again. A mark file next to Dask's scratch files records the attempts.
"""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from data_contracts.work import Work
from worldpose.errors import WorldposeError

MOST_STOPPED: Final = 2
"""Number of timeouts after which a unit is given up."""
MOST_DEATHS: Final = 3
"""Number of process deaths after which a unit is given up: fewer than Dask tolerates for units on
the same worker."""
FRAMES_SHOWN: Final = 3
"""Stack frames of a hung unit in its message."""
BEGUN: Final = "begun"


class TaskTimeoutError(WorldposeError):
    """A unit exceeded its time limit at each attempt."""


class WorkerCrashError(WorldposeError):
    """A unit ended its process at each attempt."""


@contextmanager
def kill_on_timeout(work: Work) -> Iterator[None]:
    """End this worker if the block exceeds the time limit of the work.

    Outside Dask workers there is no limit: the process belongs to the caller. TaskTimeoutError or
    WorkerCrashError if the unit reached the maximum number of timeouts, or of process deaths.
    """
    mark = _mark_of(work)
    if mark is None:
        yield
        return
    before = mark.read_text().splitlines() if mark.exists() else []
    stopped = [line for line in before if line != BEGUN]
    deaths = len(before) - 2 * len(stopped)  # one line per start, and one per timeout
    if len(stopped) >= MOST_STOPPED or deaths >= MOST_DEATHS:
        mark.unlink(missing_ok=True)
        _give_up(work, stopped, deaths)
    _append(mark, BEGUN)
    is_done = threading.Event()
    thread = threading.get_ident()
    threading.Thread(target=_watch, args=(is_done, work, mark, thread), daemon=True).start()
    try:
        yield
    finally:
        is_done.set()
        mark.unlink(missing_ok=True)


def was_interrupted(work: Work) -> bool:
    """Return whether a process on this machine ended while it computed this unit of the run."""
    mark = _mark_of(work)
    return mark is not None and mark.exists()


def _give_up(work: Work, stopped: list[str], deaths: int) -> None:
    name = work.recipe.name
    if len(stopped) >= MOST_STOPPED and work.seconds is not None:
        raise TaskTimeoutError(
            f"{name} was stopped {len(stopped)} times, each time after {work.seconds / 60.0:g} "
            f"minutes, at {stopped[-1]}. If it only needs longer, run again with a higher "
            "--time-limit."
        )
    raise WorkerCrashError(
        f"{name}: its process ended {deaths} times while it was at work, killed or by a crash. "
        "The system's log says which (out of memory?), the worker's log what came before; other "
        "units are not affected. Run again to try it once more."
    )


def _watch(is_done: threading.Event, work: Work, mark: Path, thread: int) -> None:
    if is_done.wait(work.seconds):
        return
    frames = traceback.extract_stack(sys._current_frames().get(thread))[-FRAMES_SHOWN:]
    try:
        _append(mark, ", ".join(f"{each.name} ({each.filename}:{each.lineno})" for each in frames))
    finally:  # a full disk must not keep the process hanging
        os.kill(os.getpid(), signal.SIGKILL)


def _append(mark: Path, line: str) -> None:
    with mark.open("a") as file:
        file.write(f"{line}\n")


def _mark_of(work: Work) -> Path | None:
    """Return the mark file of a work order on this machine; None outside Dask workers.

    All runs of a machine share the folder, and killed ones leave their marks. Another project, or a
    recreated one, can have the same run numbers and result keys.
    """
    # Imported here: computation without Dask never imports it.
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        return None
    run = f"{work.project} {work.run_id} {worker.scheduler.address}"
    digest = hashlib.sha256(run.encode()).hexdigest()[:16]
    name = f"worldpose-{work.recipe.match_id}-{work.key}-{digest}"
    return Path(worker.local_directory).parent / name
