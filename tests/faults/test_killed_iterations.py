"""Iterations killed anywhere and begun again; entries and a power failure."""

import multiprocessing
import os
import random
import signal
from contextlib import contextmanager

import pytest
from checker import half_written
from test_killed_runs import assert_same_store

from flows import iterate
from flows import match as match_flow
from flows.iterate import iterate_match
from flows.match import task_of
from flows.registering import open_match, register
from flows.run_record import RunLog
from flows.running import RunRequest
from flows.settings import selected_stages
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.blobs import LocalBlobs, install_fault_hook
from worldpose.store.store import Store

pytestmark = pytest.mark.faults

PASSES = 2


def compute_here(stage, units, work):
    """Compute each unit in this process, as a Prefect task on a Dask worker would."""
    task = task_of(stage)
    for unit, each in zip(units, work, strict=True):
        task.fn(each)
        yield unit, None


def run_here(store, match, request):
    match = open_match(store, match.match_id)  # as the flow does: it may have been edited
    stages = selected_stages(request.from_stage, request.until_stage)
    log = RunLog.begin(store, match, stages, request.settings, "never", request.iteration)
    return match_flow.run_stages(log, request.time_limits)


@contextmanager
def no_machines(store, request):
    yield lambda missing: request


def loop(project, folder, at_commit_point):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(match_flow, "compute", compute_here)
        patch.setattr(iterate, "run_match", run_here)
        patch.setattr(iterate, "shared_machines", no_machines)
        install_fault_hook(at_commit_point)
        store = Store.open_or_new(str(project))
        match, _ = register(store, folder)
        iterate_match(store, match, RunRequest({}), PASSES)
        install_fault_hook(None)


def loop_and_die(project, folder, skip):
    """Run the loop in a fork that is killed at the commit point after `skip` others."""
    visits = []

    def strike(point):
        visits.append(point)
        if len(visits) > skip:
            os.kill(os.getpid(), signal.SIGKILL)

    def run():
        loop(project, folder, strike)
        os._exit(0)  # nothing of the test session ends with its copy

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    process.join(300)
    return process.exitcode


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A third of a second of a small match with given cameras."""
    folder = tmp_path_factory.mktemp("short") / "match"
    options = {"duration": 0.32, "calibrated": True, "stills": False, "video": False}
    simulate_match(SCENARIOS["tiny"], 3, folder, MatchOptions(**options))
    return folder


@pytest.fixture(scope="module")
def undisturbed(short, tmp_path_factory):
    project = tmp_path_factory.mktemp("undisturbed") / "project"
    visits = []
    # Here, so that copies of this process find every kernel loaded.
    loop(project, short, visits.append)
    return project, visits


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_killed_at_a_random_commit_point_of_the_loop(seed, short, undisturbed, tmp_path):
    reference, visits = undisturbed
    skip = random.Random(seed).randrange(len(visits))
    project = tmp_path / "project"
    assert loop_and_die(project, short, skip) == -signal.SIGKILL
    assert half_written(project) == []
    loop(project, short, None)
    assert_same_store(project, reference)


@pytest.mark.parametrize("name", ["first", "further"])
def test_what_was_put_outlasts_a_power_failure(tmp_path, monkeypatch, name):
    """Content and name of an entry of a journal are synced before it is acknowledged."""
    blobs, sync, link, done = LocalBlobs(tmp_path), os.fsync, os.link, []
    if name == "further":
        assert blobs.put_new("reviews/m/0001.json", b"before")

    def record(descriptor):
        sync(descriptor)
        done.append(os.fstat(descriptor).st_ino)

    def record_link(source, target):
        link(source, target)
        done.append("linked")

    monkeypatch.setattr(os, "fsync", record)
    monkeypatch.setattr(os, "link", record_link)
    assert blobs.put_new("reviews/m/0002.json", b"acknowledged")
    entry = tmp_path / "reviews" / "m" / "0002.json"
    linked = done.index("linked")
    assert entry.stat().st_ino in done[:linked]
    assert entry.parent.stat().st_ino in done[linked:]
