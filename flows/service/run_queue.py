"""Runs of a served project in its queue: how Prefect's runs enter it, and their heartbeats."""

from __future__ import annotations

import logging
import os
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import psutil

from data_contracts.operations import Heartbeat, QueuedRun
from flows.patience import clock_of_this_thread
from flows.progress import Reporter, format_duration
from flows.service.layout import PRIORITIES
from worldpose.formats.files import bytes_read
from worldpose.store.paths import is_name
from worldpose.store.run_queue import RunQueue, queue_of

BEAT_SECONDS: Final = 15.0
"""Interval of heartbeats [s]."""
FIXED: Final = ("project", "plan")
"""Parameters that a deployment decides."""
_AGAIN: Final = re.compile(r"queue-([A-Za-z0-9-]{1,60})\.\d+")
"""Idempotency key of a run that is created again."""

LOG = logging.getLogger("worldpose.operations")


def queued_run(flow: str, run: Mapping[str, Any]) -> QueuedRun:
    """Return the first state of a run that Prefect's API describes.

    A run that was created again after the loss of Prefect's database keeps its id in its key.
    """
    again = _AGAIN.fullmatch(run["idempotency_key"] or "")
    asked_at = datetime.fromisoformat(run["created"].replace("Z", "+00:00"))
    match_id = str(run["parameters"].get("match_id") or "")
    return QueuedRun(
        # The first digits of Prefect's ids are those of their time.
        id=again[1] if again else f"{asked_at:%Y%m%dT%H%M%S}-{run['id'][-12:]}",
        flow=flow,
        name=run["name"],
        match_id=match_id if is_name(match_id) else "",
        parameters={name: it for name, it in run["parameters"].items() if name not in FIXED},
        priority=next((each for each in PRIORITIES if each in run["tags"]), None),
        key=run["idempotency_key"] or "",
        flow_run=run["id"],
        asked_at=asked_at,
        changed_at=datetime.now(UTC),
    )


def queue_of_parameters(parameters: Mapping[str, Any]) -> RunQueue:
    """Return the queue of the project that parameters of an installed flow name."""
    project = parameters.get("project") or parameters["plan"]["project"]
    return queue_of(str(project))


def find_process(pid: int | None, argument: str) -> psutil.Process | None:
    """Return a process of this machine that was started with an argument; None if it has ended."""
    try:
        process = psutil.Process(pid or 0)
        is_it = argument in process.cmdline() and process.status() != psutil.STATUS_ZOMBIE
        return process if is_it else None
    except psutil.Error:
        return None


@contextmanager
def beating(queue: RunQueue, run: QueuedRun, inputs: Path | None = None) -> Iterator[None]:
    """Write heartbeats while the calling thread makes progress in the block.

    Progress is processor time of this thread, or bytes of files that any thread hashes. While it
    waits for units, which have time limits of their own, the process and the disks of the store
    and of the folder `inputs` must answer.
    """
    ended, clock = threading.Event(), clock_of_this_thread()

    def write() -> None:
        before, number = (-1.0, -1), 0
        while True:
            now, (share, doing, left) = (clock(), bytes_read()), _describe(Reporter.current)
            if now != before or left:
                number += 1
                said = Heartbeat(number=number, share=share, doing=doing, at=datetime.now(UTC))
                try:
                    if inputs is not None:
                        ask_disk(inputs)
                    queue.put_beat(run, said)
                except Exception as error:  # as on a full disk: then there is no heartbeat
                    LOG.warning("%s: no heartbeat: %s", run.name, error)
            before = now
            if ended.wait(BEAT_SECONDS):
                return

    writer = threading.Thread(target=write, name="heartbeat", daemon=True)
    writer.start()
    try:
        yield
    finally:
        ended.set()
        writer.join(5.0)  # a last heartbeat must not follow the run's end; a disk can be frozen


def ask_disk(folder: Path) -> None:
    """Return when the disk of a match folder has answered; an error is an answer too."""
    with suppress(OSError):
        list(folder.iterdir())
        with (folder / "match.yaml").open("rb", buffering=0) as file:
            if hasattr(os, "posix_fadvise"):  # else memory may answer, as on macOS
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            file.read(1)


def _describe(reporter: Reporter | None) -> tuple[float, str, int]:
    """Return the share of a run, what it does, and the units of its stage to be computed."""
    if reporter is None or not reporter.stage:
        return 0.0, "", 0
    at, left = reporter.run_progress, max(reporter.left, 0)
    units = f", {left} {'result' if left == 1 else 'results'} of this step left" if left else ""
    doing = f"{reporter.stage}{units}"
    if at.seconds_left is not None:
        doing += f", about {format_duration(at.seconds_left)} to the end of the run"
    return min(max(at.share, 0.0), 1.0), doing, left
