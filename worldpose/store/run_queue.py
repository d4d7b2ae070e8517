"""Queue of a served project: which runs were asked for, begun, and how they ended.

Each state of a run is a sealed file, created once: `queue/<flow>/<match>/<run>.<number>.json`,
without match for runs of none. Of two writers of one number the first wins. What schedules the runs
may forget them: the last states say which are due.
"""

from __future__ import annotations

import logging
import os
import platform
import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import Any, Final

from data_contracts.operations import Heartbeat, QueuedRun, QueueState
from worldpose.errors import CorruptionError
from worldpose.store.blobs import Blobs
from worldpose.store.documents import seal, unseal
from worldpose.store.paths import queue_folder, queue_path
from worldpose.store.store import open_blobs

ENDED: Final = ("complete", "failed", "cancelled")
MAX_KILLS: Final = 3
"""Number of kills after which a run stays failed and needs an operator."""
MAX_SERVICE_DEATHS: Final = 10
"""Ends with the whole service that do not count as kills; a run may be to blame for them."""
_FILE: Final = re.compile(r"(queue/.+)\.(\d{4,})\.json")

LOG = logging.getLogger("worldpose.operations")


class RunQueue:
    """The queue of one project. A process reads each state once."""

    def __init__(self, blobs: Blobs) -> None:
        self.blobs = blobs
        self._known: dict[str, QueuedRun | None] = {}

    def runs(self, folder: str = "queue") -> list[QueuedRun]:
        """Return the last state of each run below a folder, in the order of the requests."""
        last = {}
        for entry in self.blobs.entries(folder):  # sorted, so that later states replace earlier
            found = _FILE.fullmatch(entry.path)
            if found is not None:
                last[found[1]] = entry.path
        known = dict(self._known)  # other threads replace it
        unread = [path for path in last.values() if path not in known]
        # Number of parallel readers: in object storage each state is a separate request.
        reader_count = 8
        with ThreadPoolExecutor(reader_count) as readers:
            known |= zip(unread, readers.map(self._read, unread), strict=True)
        current = {path: known[path] for path in last.values()}
        self._known = current if folder == "queue" else known
        return sorted(filter(None, current.values()), key=lambda run: (run.asked_at, run.id))

    def open_runs(self) -> list[QueuedRun]:
        """Return all runs that have not ended, in the order of the requests."""
        return [run for run in self.runs() if run.state not in ENDED]

    def latest(self, run: QueuedRun) -> QueuedRun:
        """Return the last state of a run."""
        return next((it for it in self.runs(queue_folder(run)) if it.id == run.id), run)

    def take(self, run: QueuedRun) -> QueuedRun:
        """Record the first state of a run unless it is known; return its last state."""
        self.add(run)
        return self.latest(run)

    def add(self, run: QueuedRun) -> bool:
        """Record a state; return False if another process has recorded one of its number."""
        return self.blobs.put_new(queue_path(run), seal(run))

    def change(
        self,
        run: QueuedRun,
        state: QueueState,
        message: str = "",
        **more: Any,  # noqa: ANN401
    ) -> QueuedRun | None:
        """Record the next state of a run; None if another process has recorded one meanwhile.

        A run that has ended can only be asked for again.
        """
        if run.state in ENDED and state != "asked":
            return None
        update = {"number": run.number + 1, "state": state, "message": message, **more}
        after = run.model_copy(update={**update, "changed_at": datetime.now(UTC)})
        if not self.add(after):
            return None
        if state in ENDED:
            self.blobs.delete(_beat_path(run))
        return after

    def begin(self, run: QueuedRun, flow_run: str) -> QueuedRun | None:
        """Record that this process computes a run from now on; None if the run has ended."""
        process: dict[str, Any] = {"host": platform.node(), "pid": os.getpid()}
        process["worker_pid"] = os.getppid()
        return self._insist(run, "begun", flow_run=flow_run, **process)

    def cancel(self, run: QueuedRun, why: str) -> QueuedRun | None:
        """Record that a run is cancelled, whatever it does now; None if it has ended."""
        return self._insist(run, "cancelled", why)

    def _insist(
        self,
        run: QueuedRun,
        state: QueueState,
        why: str = "",
        **more: Any,  # noqa: ANN401
    ) -> QueuedRun | None:
        """Record a state, after those of other processes, of a run that has not ended."""
        number = -1
        while (run := self.latest(run)).state not in ENDED:
            if run.number == number:  # its next state is there, and cannot be read
                raise RuntimeError(f"the state after {number} of the run {run.id} is damaged")
            if after := self.change(run, state, why or run.message, **more):
                return after
            number = run.number
        return None

    def kill(
        self, run: QueuedRun, why: str, *, by_service: bool = False, stalled: str = ""
    ) -> QueuedRun | None:
        """Record that a run lost its process or machines: it restarts, or has failed for good."""
        kills, deaths = run.kills + (not by_service), run.service_deaths + by_service
        starts = kills + max(0, deaths - MAX_SERVICE_DEATHS)
        more = {"kills": kills, "service_deaths": deaths, "stalled": stalled or run.stalled}
        if starts < MAX_KILLS:
            return self.change(run, "killed", why, **more)
        return self.change(run, "failed", f"{why}; it was begun {kills + deaths} times", **more)

    def put_beat(self, run: QueuedRun, beat: Heartbeat) -> None:
        """Replace the heartbeat of a run."""
        self.blobs.put(_beat_path(run), seal(beat))

    def beat(self, run: QueuedRun) -> Heartbeat | None:
        """Return the last heartbeat of a run; None before the first, or if it is damaged."""
        data = self.blobs.read(_beat_path(run))
        try:
            return None if data is None else unseal(Heartbeat, data, _beat_path(run))
        except CorruptionError:
            return None

    def forget_ended(self, age: timedelta) -> None:
        """Remove runs that ended longer ago; the end of the last of each match and flow stays."""
        before, runs = datetime.now(UTC) - age, self.runs()
        last = {queue_folder(run): run for run in runs}.values()
        kept = {run.id for run in (*last, *last_ended(runs))}
        old = {
            queue_path(run).rpartition(".")[0].rpartition(".")[0]: run
            for run in runs
            if run.state in ENDED and run.changed_at < before
        }
        for entry in self.blobs.entries("queue"):
            found = _FILE.fullmatch(entry.path)
            run = None if found is None else old.get(found[1])
            if run is not None and (run.id not in kept or entry.path != queue_path(run)):
                self.blobs.delete(entry.path)

    def _read(self, path: str) -> QueuedRun | None:
        data = self.blobs.read(path)
        try:
            return None if data is None else unseal(QueuedRun, data, f"{self.blobs.url}/{path}")
        except CorruptionError as error:
            LOG.warning("%s; `worldpose verify --repair` sets it aside", error)
            return None


@cache
def queue_of(url: str) -> RunQueue:
    """Return the queue of a project."""
    return RunQueue(open_blobs(url))


def last_ended(runs: Iterable[QueuedRun]) -> list[QueuedRun]:
    """Return the last run to end of each match and flow, except cancelled ones."""
    ended = (run for run in runs if run.state in ("complete", "failed"))
    return list({queue_folder(run): run for run in ended}.values())


def _beat_path(run: QueuedRun) -> str:
    return f"{queue_folder(run)}/{run.id}.beat.json"
