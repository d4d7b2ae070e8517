"""A small match to put into inboxes, a served project, a Postgres server, a Dask cluster."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from service import Served, free_ports

from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS


@pytest.fixture(scope="session")
def small_match(tmp_path_factory):
    """A match folder of three cameras and two people; read only."""
    folder = tmp_path_factory.mktemp("arriving") / "small"
    tiny = SCENARIOS["tiny"]
    small = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
    simulate_match(tiny, 0, folder, MatchOptions(**small))
    return folder


@pytest.fixture
def drop(small_match, tmp_path):
    (tmp_path / "inbox").mkdir()

    def copy(name="small"):
        return shutil.copytree(small_match, tmp_path / "inbox" / name)

    return copy


@pytest.fixture
def postgres():
    """The address of a database in a Postgres server, and a function that asks it."""
    programs = Path("/usr/lib/postgresql")
    found = sorted(programs.glob("*/bin/postgres"))
    if not found:
        pytest.skip("no Postgres server is installed")
    (port,) = free_ports(1)
    folder = Path(tempfile.mkdtemp(prefix="postgres-", dir="/tmp"))
    who = {"user": "postgres", "group": "postgres"} if os.geteuid() == 0 else {}
    if who:  # Postgres refuses to be run by root
        shutil.chown(folder, **who)
    initdb = found[-1].with_name("initdb")
    making = [initdb, "-D", folder / "data", "-U", "prefect", "--auth", "trust", "--no-sync"]
    subprocess.run(making, check=True, capture_output=True, cwd=folder, **who)
    options = ["-p", str(port), "-k", str(folder), "-h", "127.0.0.1"]
    server = subprocess.Popen(
        [found[-1], "-D", folder / "data", *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=folder,
        **who,
    )

    def ask(query):
        psql = found[-1].with_name("psql")
        connection = ["-h", "127.0.0.1", "-p", str(port), "-U", "prefect", "-d", "postgres"]
        asked = [psql, *connection, "-A", "-t", "-c", query]
        return subprocess.run(asked, capture_output=True, text=True).stdout.strip()

    deadline = time.monotonic() + 120
    while ask("select 1") != "1":
        assert time.monotonic() < deadline, "Postgres does not answer"
        time.sleep(0.5)
    yield f"postgresql+asyncpg://prefect@127.0.0.1:{port}/postgres", ask
    server.send_signal(signal.SIGINT)
    server.wait(60)
    shutil.rmtree(folder)


@pytest.fixture
def dask():
    """The address of a Dask scheduler with two workers, each a process of its own; their ids."""
    (port,) = free_ports(1)
    address = f"tcp://127.0.0.1:{port}"
    python = [sys.executable, "-m"]
    scheduler = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)]
    worker = ["distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
    worker += ["--preload", "tasks.preload"]  # as all deployments do
    commands = [[*python, *scheduler, "--no-dashboard"], *[[*python, *worker]] * 2]
    processes = [subprocess.Popen(each, stderr=subprocess.DEVNULL) for each in commands]
    deadline = time.monotonic() + 120
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        assert time.monotonic() < deadline, "Dask's scheduler does not answer"
        time.sleep(0.2)
    yield address, [process.pid for process in processes[1:]]
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait(60)


@pytest.fixture
def served(tmp_path, webhook):
    service = Served(tmp_path, webhook.address)
    yield service
    if service.process is not None and service.process.poll() is None:
        service.end(signal.SIGKILL)
