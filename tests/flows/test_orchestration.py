"""Prefect and Dask as processes: what is lost is named, work is spread, changes are repeated."""

import math
import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import dask
import httpx
import pytest
from command_line import TINY, succeed
from distributed import Client, LocalCluster, Worker, get_worker
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError
from starlette.applications import Starlette
from starlette.responses import JSONResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from flows.match import on_workers_with, task_count
from flows.orchestration import local_cluster
from flows.orchestration.local_cluster import LostWorkersError, require_workers
from flows.orchestration.prefect_environment import (
    CLIENT_LOGIN,
    authorization,
    local_cluster_options,
)
from flows.orchestration.prefect_server import REPETITIONS, RepeatBusy
from worldpose.errors import WorldposeError

LOOPBACK_ONLY = str(Path(__file__).with_name("loopback_only"))


@pytest.fixture
def no_server(monkeypatch):
    monkeypatch.delenv("PREFECT_API_URL", raising=False)


def test_an_embedded_run_reaches_nothing_but_this_machine(no_server, tiny, tmp_path):
    notes = tmp_path / "notes"
    # A proxy must not be asked for this machine itself either.
    proxies = dict.fromkeys(("HTTP_PROXY", "http_proxy"), "http://192.0.2.1:3128")
    environment = {"PYTHONPATH": LOOPBACK_ONLY, "WORLDPOSE_TEST_NOTES": str(notes), **proxies}
    probe = [sys.executable, "-c", "import socket; socket.create_connection(('192.0.2.1', 80), 1)"]
    assert subprocess.run(probe, env={**os.environ, **environment}, capture_output=True).returncode
    assert "192.0.2.1" in notes.read_text(), "the guard does not work"
    notes.unlink()
    project = tmp_path / "worldpose-data"
    part = ("--until", "ingest")
    succeed("run", tiny, "--project", project, *part, environment=environment)
    assert not notes.exists(), notes.read_text()


def test_a_run_is_visible_at_the_server_by_name(server, tiny, tmp_path):
    succeed("run", tiny, "--project", tmp_path / "worldpose-data", "--until", "ingest")
    login = {"authorization": authorization(os.environ[CLIENT_LOGIN])}

    def ask(kind):
        asked = {"sort": "EXPECTED_START_TIME_DESC", "limit": 50}
        return httpx.post(f"{server}/{kind}/filter", json=asked, headers=login).json()

    run = ask("flow_runs")[0]
    assert (run["name"], run["state_name"]) == (TINY, "Completed")
    assert run["parameters"]["match_id"] == TINY
    tasks = {task["name"] for task in ask("task_runs") if task["flow_run_id"] == run["id"]}
    assert any(name.startswith("ingest") for name in tasks)


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
    monkeypatch.setattr(local_cluster, "START_SECONDS", 2.0)
    with (
        dask.config.set({"distributed.worker.preload": ["no_such_module"]}),
        closing(local_cluster.start_cluster(1, [])) as cluster,
        pytest.raises(WorldposeError, match="No worker process started within 2 s"),
    ):
        local_cluster.wait_for_worker(cluster)


def where(number):
    return get_worker().name


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers in this process, one of them with a tag."""
    specification = {
        "plain": {"cls": Worker, "options": {"nthreads": 1}},
        "tagged": {"cls": Worker, "options": {"nthreads": 1, "resources": {"GPU": 1}}},
    }
    kept = {"processes": False, "n_workers": 0, "dashboard_address": None}
    with LocalCluster(**kept) as cluster:
        cluster.worker_spec.update(specification)
        cluster.sync(cluster._correct_state)
        yield cluster


@pytest.mark.parametrize(
    ("tag", "places"),
    [("GPU", {"tagged"}), ("TPU", {"plain", "tagged"}), (None, {"plain", "tagged"})],
)
def test_work_goes_to_workers_with_the_tag_where_there_are_any(tag, places, cluster):
    with Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2)
        with on_workers_with(tag, client):
            asked = [client.submit(where, number, pure=False) for number in range(8)]
        assert set(client.gather(asked)) == places


@pytest.mark.parametrize(
    ("seconds", "workers", "tasks"),
    [
        (17 * [0.8], 1, 3),
        (17 * [0.35], 4, 4),
        (3 * [0.35], 4, 3),
        (16 * [0.35] + [math.inf], 1, 17),
        (9000 * [0.35], 1, 200),
        (500 * [math.inf], 2, 40),
        ([], 1, 0),
    ],
)
def test_short_or_many_units_share_tasks(seconds, workers, tasks):
    assert task_count(seconds, workers) == tasks


class BusyError(Exception):
    """The database's."""


@pytest.fixture
def busy_server():
    """A server that refuses so many requests, as Prefect does, and what it was sent."""

    async def create(request):
        app.state.got.append(await request.json())
        if len(app.state.got) <= app.state.refusals:
            raise BusyError
        return JSONResponse({"number": len(app.state.got)}, 201)

    async def say_busy(request, error):
        return JSONResponse({"exception_message": "Service Unavailable"}, 503)

    routes = [Route("/create", create, methods=["POST"])]
    app = Starlette(routes=routes, exception_handlers={Exception: say_busy})
    app.state.got, app.state.refusals = [], 0
    return app


def send(app):
    client = TestClient(RepeatBusy(app, pause_s=0.0), raise_server_exceptions=False)
    return client.post("/create", json={"run": 1})


@pytest.mark.parametrize("refusals", [1, REPETITIONS, 100])
def test_a_refused_change_is_made_again_as_it_was_until_that_is_told(busy_server, refusals):
    busy_server.state.refusals = refusals
    answer, sent = send(busy_server), min(refusals, REPETITIONS) + 1
    assert answer.status_code == (201 if refusals <= REPETITIONS else 503)
    assert busy_server.state.got == [{"run": 1}] * sent


def test_another_error_is_passed_on_once(busy_server):
    assert TestClient(RepeatBusy(busy_server)).post("/none").status_code == 404
    assert TestClient(RepeatBusy(busy_server)).get("/create").status_code == 405
