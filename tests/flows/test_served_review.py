"""A run that waits for a review resumes where it stopped, whatever is killed meanwhile."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import httpx
import pytest
from command_line import TINY, WORLDPOSE

from data_contracts.review import ReviewDecision
from flows.registering import register
from worldpose.review.journal import read_journal
from worldpose.store.store import Store

pytestmark = pytest.mark.slow  # three servers, each started twice

TOKEN = "a token for the served run"
DEPLOYING = """
from flows.service.deployed import match
match.serve(name="reviewed", pause_on_shutdown=False)
"""
PATIENCE = 300.0
"""Maximum time for the start of a process and for a flow on two busy cores [s]."""


class Servers:
    """Prefect's server, the process that serves the deployment, and the pages'."""

    def __init__(self, folder, project):
        ports = [free_port() for _ in range(2)]
        self.prefect = httpx.Client(base_url=f"http://127.0.0.1:{ports[0]}/api", timeout=60)
        self.pages = httpx.Client(base_url=f"http://127.0.0.1:{ports[1]}", timeout=60)
        self.environment = {
            **os.environ,
            "PREFECT_HOME": str(folder / "prefect"),
            "PREFECT_API_URL": str(self.prefect.base_url).rstrip("/"),
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "DO_NOT_TRACK": "1",
            "NO_PROXY": "127.0.0.1",
            "PREFECT_RUNNER_POLL_FREQUENCY": "1",
            "WORLDPOSE_REVIEW_TOKEN": TOKEN,
        }
        host = ("--host", "127.0.0.1", "--port", str(ports[0]))
        page = ("--port", str(ports[1]), "--project", str(project))
        self.commands = [
            [sys.executable, "-m", "prefect", "server", "start", "--no-ui", *host],
            [*WORLDPOSE, "review", "serve", *page],
            [sys.executable, "-c", DEPLOYING],
        ]
        self.folder, self.processes = folder, []

    def start(self):
        for number, command in enumerate(self.commands):
            log = self.folder / f"said{number}.log"
            with log.open("ab") as output:
                process = subprocess.Popen(
                    command,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=self.environment,
                    start_new_session=True,
                )
            self.processes.append(process)
            if number == 0:
                wait_until(lambda: answers(self.prefect, "/health"), log)
        wait_until(lambda: answers(self.pages, "/api/health"), log)

    def kill(self):
        for process in self.processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self.processes.clear()

    def log_in(self):
        """A person at the page, with the form secret of a new session."""
        self.pages.cookies.clear()
        assert self.pages.post("/api/login", json={"who": "Ada", "token": TOKEN}).is_success
        self.pages.headers["x-form-secret"] = self.pages.get("/api/session").json()["form_secret"]


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]


def answers(client, path):
    try:
        return client.get(path).is_success
    except httpx.TransportError:
        return False


def wait_until(holds, *about):
    deadline = time.monotonic() + PATIENCE
    while not (found := holds()):
        assert time.monotonic() < deadline, about
        time.sleep(0.5)
    return found


@pytest.fixture
def served(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    store = Store.create(tmp_path / "project")
    register(store, folder)
    servers = Servers(tmp_path, tmp_path / "project")
    yield servers, store
    servers.kill()


def test_a_run_that_waits_outlives_all_servers_and_goes_on_from_the_page(served):
    servers, store = served
    servers.start()
    given = {
        "project": store.url,
        "match_id": TINY,
        "settings": {},
        "until_stage": "static_calibration",
        "gates": "always",
    }
    deployed = wait_until(lambda: found(servers.prefect, "/deployments/name/match/reviewed"))
    asked = servers.prefect.post(
        f"/deployments/{deployed['id']}/create_flow_run", json={"parameters": given}
    )
    run = f"/flow_runs/{asked.json()['id']}"

    def state():
        name = servers.prefect.get(run).json()["state"]["name"]
        assert name not in ("Failed", "Crashed"), name
        return name

    wait_until(lambda: state() == "Suspended")
    first = store.run(TINY)
    assert (first.run_id, first.state, len(first.waiting)) == ("0001", "waiting", 6)

    servers.kill()
    servers.start()
    assert state() == "Suspended"
    # An answer without a verdict is none, at Prefect's form as on the page.
    for empty in ({}, {"run_input": {}}, {"run_input": {"who": "Ada"}}):
        answer = servers.prefect.post(f"{run}/resume", json=empty).json()
        assert answer["status"] == "REJECT", answer
    servers.log_in()
    path = f"/api/matches/{TINY}"
    names = [each["id"] for each in servers.pages.get(path).json()["reviews"]]
    assert len(names) == 6
    for body in ({}, {"reviews": names, "seen": {}}):
        assert servers.pages.post(f"{path}/decisions", json=body).status_code == 422
    assert servers.pages.post(f"{path}/runs", json={}).status_code == 422  # no decision yet
    assert (state(), store.runs(TINY)) == ("Suspended", ("0001",))

    verdict = {"verdict": "approve", "why": "looked", "seen": dict.fromkeys(names, "waits")}
    last = {"reviews": names, **verdict}
    answer = servers.pages.post(f"{path}/decisions", json=last).json()
    assert (answer["waiting"], answer["run"]["state"]) == (0, "resumed")
    wait_until(lambda: state() == "Completed")
    second = store.run(TINY)
    assert (second.run_id, second.state) == ("0002", "complete")
    assert second.executed == ()  # nothing before the gate was computed again
    assert second.results == first.results
    records = read_journal(store, TINY).records
    decided = [each for each in records if isinstance(each, ReviewDecision)]
    assert [(each.who, each.verdict) for each in decided] == [("Ada", "approve")] * 6


def found(client, path):
    answer = client.get(path)
    return answer.json() if answer.is_success else None
