"""A lost Prefect server or Dask scheduler is not a unit's failure."""

import time
from contextlib import closing

import dask
import httpx
import pytest
from distributed import Client, LocalCluster
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from flows.orchestration import local_cluster
from flows.orchestration.local_cluster import LostWorkersError, require_workers
from flows.orchestration.prefect_environment import local_cluster_options
from worldpose.errors import WorldposeError


@pytest.mark.parametrize(
    ("failure", "lost"),
    [
        (FutureCancelledError("tracking-1", "scheduler-connection-lost"), "Dask scheduler"),
        (CommClosedError("in <TCP>"), "Dask scheduler"),
        (httpx.ConnectError("refused"), "Prefect server"),
        (RuntimeError("Failed to reach API at http://127.0.0.1:4200/api/"), "Prefect server"),
    ],
)
def test_what_is_lost_is_named_and_how_to_go_on(failure, lost):
    with pytest.raises(LostWorkersError, match=f"the {lost} was lost.*run again") as told:
        require_workers(failure)
    require_workers(told.value)  # told once


def test_a_worker_that_is_gone_for_good_is_begun_anew(monkeypatch):
    monkeypatch.setattr(local_cluster, "KEEP_SECONDS", 0.1)
    soon = {"distributed.deploy.lost-worker-timeout": 0.1}
    with (
        dask.config.set(soon),
        LocalCluster(**local_cluster_options(1)) as cluster,
        local_cluster.keep_workers(cluster) as ask_for,
        Client(cluster, set_as_default=False) as client,
    ):
        client.wait_for_workers(1, 60)
        ((first, nanny),) = cluster.workers.items()
        cluster.sync(nanny.close)  # as one does whose worker ends while it starts
        end = time.monotonic() + 60
        while cluster.workers.get(first) in (nanny, None):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert client.submit(sum, (1, 2)).result(60) == 3
        ask_for(2)
        client.wait_for_workers(2, 60)
        time.sleep(0.3)  # the next looks after them keep both
        assert len(cluster.worker_spec) == 2


def test_workers_that_cannot_import_their_modules_are_told(monkeypatch):
    monkeypatch.setattr(local_cluster, "START_SECONDS", 5.0)
    with (
        dask.config.set({"distributed.worker.preload": ["no_such_module"]}),
        closing(local_cluster.start_cluster(1, [])) as cluster,
        pytest.raises(WorldposeError, match="No worker process started within 5 s"),
    ):
        local_cluster.wait_for_worker(cluster)
