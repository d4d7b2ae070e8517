"""Marks of units that were begun: who ends its process too often is given up."""

import os
import time
from types import SimpleNamespace

import pytest

from data_contracts.work import Recipe, Work
from tasks.watchdog import TaskTimeoutError, WorkerCrashError, kill_on_timeout, was_interrupted
from worldpose.store.recipes import recipe_key


@pytest.fixture
def work(tmp_path, monkeypatch):
    at_work(monkeypatch, tmp_path, "tcp://127.0.0.1:1000")
    nothing = {"sources": {}, "inputs": {}, "settings": {}, "code": {}, "libraries": {}}
    recipe = Recipe(match_id="m", stage="tracking", unit="c", **nothing)
    key = recipe_key(recipe)
    return Work(project="p", folder="m", recipe=recipe, key=key, run_id="0001", seconds=60.0)


def at_work(monkeypatch, scratch, scheduler):
    """Let this process pass for a worker of that scheduler."""
    address = SimpleNamespace(address=scheduler)
    worker = SimpleNamespace(local_directory=str(scratch / "worker-1"), scheduler=address)
    monkeypatch.setattr("distributed.get_worker", lambda: worker)


def die(work):
    """Leftovers of a process that ended during its work."""
    pid = os.fork()
    if pid == 0:
        with kill_on_timeout(work):
            os._exit(9)
    os.waitpid(pid, 0)


def test_who_ends_three_processes_is_given_up_once(work, tmp_path):
    assert not was_interrupted(work)
    for _ in range(3):
        die(work)
    assert was_interrupted(work)
    with pytest.raises(WorkerCrashError, match="tracking/c: its process ended 3 times"):
        kill_on_timeout(work).__enter__()
    assert list(tmp_path.iterdir()) == []
    with kill_on_timeout(work):  # it may have been the machine: the next run tries again
        pass


def test_what_killed_runs_left_counts_for_no_other_run(work, tmp_path, monkeypatch):
    for _ in range(3):
        die(work)
    with kill_on_timeout(work.model_copy(update={"project": "q"})):
        pass
    at_work(monkeypatch, tmp_path, "tcp://127.0.0.1:1001")  # a new project at the same place
    with kill_on_timeout(work):
        pass


def test_who_ends_or_fails_leaves_no_mark(work, tmp_path):
    die(work)
    with pytest.raises(ValueError, match="its own"), kill_on_timeout(work):
        raise ValueError("its own")
    assert list(tmp_path.iterdir()) == []


def test_who_takes_too_long_is_ended_and_given_up_the_second_time(work, tmp_path):
    hasty = work.model_copy(update={"seconds": 0.2})
    for _ in range(2):
        pid = os.fork()
        if pid == 0:
            with kill_on_timeout(hasty):
                time.sleep(60)
            os._exit(0)
        _, status = os.waitpid(pid, 0)
        assert os.WIFSIGNALED(status)
    with pytest.raises(TaskTimeoutError, match=r"stopped 2 times.*test_watchdog\.py"):
        kill_on_timeout(hasty).__enter__()
    assert list(tmp_path.iterdir()) == []
