"""Worker processes of a run's own, on its machine."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from flows.planning import PlannedUnit
from flows.prefect_environment import START_SECONDS, local_cluster_options

if TYPE_CHECKING:
    from flows.private_cluster import PrivateCluster

KEEP_SECONDS = 5.0
"""How often workers that are gone are begun anew."""


def starting_cluster(asked: int | None, missing: list[PlannedUnit]) -> PrivateCluster:
    """Workers on this machine that begin to start, and import at once what they will need.

    Args:
        asked: how many; None = as many as have something to do at once.
        missing: what is to be computed first.
    """
    import dask

    from flows.private_cluster import PrivateCluster

    given = dask.config.get("distributed.worker.preload")
    named = [given] if isinstance(given, str) else given
    stages = sorted({unit.recipe.stage for unit in missing})
    preload = ["tasks.preload", *named, "prefect_dask", *(f"tasks.{stage}" for stage in stages)]
    preload.append("flows.match")  # with each task Prefect sends the flow that it is of
    # Dask closes what begins a lost worker anew if that takes longer: 15 s, as long as a start on a
    # slow machine.
    dask.config.set({"distributed.deploy.lost-worker-timeout": START_SECONDS})
    workers = workers_for(asked, missing)
    cluster = PrivateCluster(
        **{**local_cluster_options(workers), "n_workers": 0, "preload": preload}
    )
    cluster.scale(workers)
    return cluster


def workers_for(asked: int | None, missing: list[PlannedUnit]) -> int:
    """How many workers were asked for, or else have something to do at once."""
    stages = Counter(unit.recipe.stage for unit in missing)
    return asked or min(os.cpu_count() or 1, max(stages.values()))


@contextmanager
def kept_complete(cluster: PrivateCluster) -> Iterator[Callable[[int], None]]:
    """Begin workers anew that are gone for good, as are those that end while they start.

    Dask notices that they are gone, but begins others only when it is asked for workers. Gives a
    function that asks for so many, if there are fewer.
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
