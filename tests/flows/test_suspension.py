"""A deployment's run waits for people at the Prefect server, and outlives its process."""

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from command_line import TINY, succeed
from prefect.client.orchestration import get_client
from prefect.deployments import run_deployment
from prefect.flow_runs import resume_flow_run

from data_contracts.review import ReviewDecision
from flows.registering import register
from worldpose.review.journal import read_journal
from worldpose.store.store import Store

pytestmark = pytest.mark.slow  # five processes that import and serve, one after the other

SERVING = """
from flows.service.deployed import match
match.serve(name="suspension", pause_on_shutdown=False)
"""
PATIENCE = 240.0
"""Maximum time for the start and end of a flow's process on two busy cores [s]."""


@pytest.fixture
def serving(server, tmp_path):
    """A function that starts a serving process, and gives a function that kills it."""
    started = []

    def start():
        log = (tmp_path / f"serving{len(started)}.log").open("wb")
        environment = {**os.environ, "PREFECT_RUNNER_POLL_FREQUENCY": "1"}
        process = subprocess.Popen(
            [sys.executable, "-c", SERVING],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        started.append(process)

        def kill():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

        return kill

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def given(tiny, tmp_path):
    """A function that registers the match, with given cameras, in a project of its own."""

    def make(name):
        folder = shutil.copytree(tiny, tmp_path / name / "match")
        shutil.copy(folder / "reference" / "calibration.toml", folder)
        store = Store.create(tmp_path / name / "project")
        register(store, folder)
        return store

    return make


def start_run(store):
    """A flow run that asks about every camera, when there is a deployment to run."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return run_deployment(
                "match/suspension",
                parameters={
                    "project": store.url,
                    "match_id": TINY,
                    "settings": {},
                    "until_stage": "static_calibration",
                    "gates": "always",
                },
                timeout=0,
            ).id
        except Exception:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


def wait_for(run_id, *names):
    deadline = time.monotonic() + PATIENCE
    with get_client(sync_client=True) as client:
        while True:
            state = client.read_flow_run(run_id).state
            if state.name in names:
                return state.name
            assert state.name not in ("Failed", "Crashed", "Completed"), state
            assert time.monotonic() < deadline, state
            time.sleep(0.5)


def decisions(store):
    records = read_journal(store, TINY).records
    return [record for record in records if isinstance(record, ReviewDecision)]


def test_a_suspended_run_outlives_its_process_and_goes_on_when_people_have_decided(serving, given):
    store = given("one")
    kill = serving()
    run = start_run(store)
    wait_for(run, "Suspended")
    kill()
    first = store.run(TINY)
    assert (first.run_id, first.state, first.gates) == ("0001", "waiting", "always")
    assert len(first.waiting) == 6
    # An answer without a verdict is none.
    with pytest.raises(RuntimeError, match="required property"):
        resume_flow_run(run, run_input={"who": "Ada"})
    with pytest.raises(RuntimeError):
        resume_flow_run(run)
    project = ("--project", store.url)
    succeed("review", "approve", TINY, "--who", "Ada", *project)
    (resumed,) = succeed("review", "resume", TINY, *project, "--json").json["resumed"]
    assert resumed.startswith(f"{TINY}, ")  # and the time of its start
    serving()
    wait_for(run, "Completed")
    second = store.run(TINY)
    assert (second.run_id, second.state) == ("0002", "complete")
    assert second.executed == ()  # nothing before the gate was computed again
    assert second.results == first.results
    assert {decision.who for decision in decisions(store)} == {"Ada"}

    # Another run is answered in Prefect's own form: one verdict on all that it asks about.
    store = given("two")
    run = start_run(store)
    wait_for(run, "Suspended")
    resume_flow_run(run, run_input={"verdict": "approve", "who": "Bob", "why": "looked"})
    wait_for(run, "Completed")
    assert [(each.verdict, each.who) for each in decisions(store)] == [("approve", "Bob")] * 6
    assert store.runs(TINY) == ("0001", "0002")
    assert store.unfinished_runs(TINY) == ()
