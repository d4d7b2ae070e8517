"""Local worker processes of a run, and failures of its machines, not of its computation."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from flows.method import task_modules
from flows.orchestration.prefect_environment import START_SECONDS, local_cluster_options
from flows.run_plan import PlannedUnit
from worldpose.errors import StoreError, WorldposeError

if TYPE_CHECKING:
    from flows.orchestration.private_cluster import PrivateCluster

START_WORK_SECONDS = 18.0
"""Processor time of units that one worker completes, two at a time, while another one starts, which
takes 9 s [s]."""
STILL_SECONDS = 0.8
"""Processor time of a camera from clicks and its still [s]."""
KEEP_SECONDS = 5.0
"""Interval at which lost workers are restarted."""
LITTLE_BYTES = 1 << 20
"""Free disk space below which Prefect's database cannot complete a transaction [byte]."""


def start_cluster(asked: int | None, missing: list[PlannedUnit]) -> PrivateCluster:
    """Start workers on this machine, which at once import the modules that they will need.

    There are as many as asked for, or as `workers_for` the units to compute first.
    """
    import dask

    from flows.orchestration.private_cluster import PrivateCluster

    given = dask.config.get("distributed.worker.preload")
    named = [given] if isinstance(given, str) else given
    modules = task_modules(unit.recipe.stage for unit in missing)
    preload = ["tasks.preload", *named, "prefect_dask", *modules]
    preload.append("flows.match")  # Prefect sends the flow along with each of its tasks
    # Dask closes a restarted worker that takes longer than this: 15 s, as long as a start on a slow
    # machine.
    dask.config.set({"distributed.deploy.lost-worker-timeout": START_SECONDS})
    workers = workers_for(asked, missing)
    cluster = PrivateCluster(
        **{**local_cluster_options(workers), "n_workers": 0, "preload": preload}
    )
    cluster.scale(workers)
    return cluster


def workers_for(asked: int | None, missing: list[PlannedUnit]) -> int:
    """Return the requested number of workers, or else the number that can work in parallel.

    Stages that one worker completes sooner than a second one starts ask for one.
    """
    stages: dict[str, list[float]] = {}
    for unit in missing:
        stages.setdefault(unit.recipe.stage, []).append(short_seconds(unit))
    wanted = [len(each) for each in stages.values() if sum(each) > START_WORK_SECONDS]
    return asked or min(os.cpu_count() or 1, max(wanted, default=1))


def short_seconds(unit: PlannedUnit) -> float:
    """Return the processor time of given 2D poses, or of a camera from clicks and a still [s].

    That of any other unit counts as infinite.
    """
    stage, sources = unit.recipe.stage, unit.recipe.sources
    films = any(sources.get(name) for name in ("video", "filmed"))
    if films or stage not in ("ingest", "static_calibration"):
        return math.inf
    if sources.get("still"):
        return STILL_SECONDS
    frames = sources.get("frame_count", 0)
    return 0.2 + (frames / 20_000 if isinstance(frames, int) else math.inf)


def wait_for_worker(cluster: PrivateCluster) -> None:
    """Return when the first worker has started; WorldposeError if none did in time."""
    try:
        cluster.wait_for_workers(1, START_SECONDS)
    except TimeoutError:
        raise WorldposeError(
            f"No worker process started within {START_SECONDS:.0f} s. Import the modules that it "
            "imports at its start to see why: python -c 'import tasks.preload, flows.match', and "
            "those of distributed.worker.preload in Dask's configuration."
        ) from None


@contextmanager
def keep_workers(cluster: PrivateCluster) -> Iterator[Callable[[int], None]]:
    """Restart workers that are permanently gone, such as those that end while they start.

    Dask notices that they are gone, but starts others only on request. Yields a function that
    requests a number of workers, if there are fewer.
    """
    most = len(cluster.worker_spec)
    is_over, asking = threading.Event(), threading.Lock()

    def ask_for(workers: int) -> None:
        nonlocal most
        with asking:
            most = max(most, workers)
            cluster.scale(most)

    def keep() -> None:
        while not is_over.wait(KEEP_SECONDS):
            ask_for(0)

    keeper = threading.Thread(target=keep, daemon=True)
    keeper.start()
    try:
        yield ask_for
    finally:
        is_over.set()
        keeper.join()


class LostWorkersError(WorldposeError):
    """The Prefect server or the Dask scheduler of a run was lost; finished results are kept."""


def require_room(failure: BaseException, project: str) -> None:
    """Raise StoreError if a failure of Prefect was caused by a full disk; else return.

    Prefect reports failures of its database, in a temporary folder, only as `500`.
    """
    if isinstance(failure, StoreError):
        return
    folders = {tempfile.gettempdir(): "Prefect keeps its database"}
    if "://" not in project:
        folders = {project: "results are written", **folders}
    for folder, use in folders.items():
        free = shutil.disk_usage(folder).free
        if free < LITTLE_BYTES:
            raise StoreError(
                f"{folder}: No space left on device ({free} bytes are free), where {use}. "
                "Free space there and run again; published results are untouched."
            ) from failure


def require_workers(failure: BaseException) -> None:
    """Raise LostWorkersError if a unit failed because its machines are gone; else return.

    Other units of the run would fail too.
    """
    # Imported here: only runs that compute need them.
    import httpx
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    if isinstance(failure, LostWorkersError):
        return
    if isinstance(failure, FutureCancelledError | CommClosedError):
        lost = "the Dask scheduler"
    elif isinstance(failure, httpx.TransportError) or "Failed to reach API" in str(failure):
        lost = "the Prefect server"
    else:
        return
    said = str(failure) or type(failure).__name__
    raise LostWorkersError(
        f"{lost} was lost ({said}). Finished results are kept: run again when it is back."
    ) from failure
