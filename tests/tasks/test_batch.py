"""Units on workers: in batches, tried again, timed out, and heard of."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from data_contracts.work import Recipe, Work
from tasks import batch, tracking
from tasks.watchdog import TaskTimeoutError, WorkerCrashError, kill_on_timeout, was_interrupted
from worldpose.errors import DegenerateError, StoreError
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store


def a_work(project, unit, **about):
    parts = {key: {} for key in ("sources", "inputs", "settings", "code", "libraries")}
    recipe = Recipe(match_id="m", stage="tracking", unit=unit, **parts)
    about |= {"project": project, "folder": "m", "recipe": recipe}
    return Work(key=recipe_key(recipe), run_id="0001", **about)


@pytest.fixture
def works(tmp_path):
    """Work on three units of a project."""
    Store.create(str(tmp_path))
    return [a_work(str(tmp_path), unit) for unit in "abc"]


def run(works, compute, monkeypatch):
    monkeypatch.setattr(tracking, "tracking", SimpleNamespace(fn=compute))
    monkeypatch.setattr(batch, "RETRY_SECONDS", 0.0)
    return batch.batch.fn("tracking", "tasks.tracking", [each.model_dump_json() for each in works])


def test_a_units_failure_is_its_own_and_what_may_pass_is_tried_again(works, monkeypatch):
    tried = []

    def compute(work):
        unit = work.recipe.unit
        tried.append(unit)
        if unit == "c":
            raise DegenerateError("no person to be seen")
        if tried.count("b") < 3:
            raise StoreError("no space")

    monkeypatch.setattr(Store, "has", lambda self, match, stage, unit, key: unit == "a")
    failures = run(works, compute, monkeypatch)
    assert (sorted(tried), tried.count("b")) == (["b", "b", "b", "c"], 3)  # `a` is there
    assert [type(each) for each in failures] == [type(None), type(None), DegenerateError]
    monkeypatch.setattr(Store, "has", lambda *_: False)

    def never(work):
        raise StoreError("no space")

    assert [type(each) for each in run(works, never, monkeypatch)] == [StoreError] * 3


SCRIPT = """
import threading, time
from prefect.context import TaskRunContext
from prefect.events.worker import EventsWorker
from prefect.settings import PREFECT_API_URL, temporary_settings
from tasks.unit import MAX_SERVERS, send_to_own_server

def log_senders():
    return sum(each.name == "APILogWorkerThread" for each in threading.enumerate())

with TaskRunContext.model_construct():
    for number in range(3 * MAX_SERVERS):
        address = f"http://127.0.0.1:{9 + number}/api"  # nothing listens there
        with temporary_settings({PREFECT_API_URL: address}):
            send_to_own_server()
            assert EventsWorker._client_override[1][0] == ("api_url", address)
deadline = time.monotonic() + 60
while log_senders() > MAX_SERVERS and time.monotonic() < deadline:
    time.sleep(0.1)
print(log_senders())
"""


def test_a_worker_sends_to_the_server_of_its_run_and_keeps_few_connections():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.strip() == "4"


@pytest.fixture
def work(tmp_path, monkeypatch):
    at_work(monkeypatch, tmp_path, "tcp://127.0.0.1:1000")
    return a_work("p", "c", seconds=60.0)


def at_work(monkeypatch, scratch, scheduler):
    """Let this process pass for a worker of that scheduler."""
    address = SimpleNamespace(address=scheduler)
    worker = SimpleNamespace(local_directory=str(scratch / "worker-1"), scheduler=address)
    monkeypatch.setattr("distributed.get_worker", lambda: worker)


def die(work, seconds=0):
    """Leftovers of a process that ended during its work."""
    pid = os.fork()
    if pid == 0:
        with kill_on_timeout(work):
            time.sleep(seconds)
            os._exit(9)
    return os.waitpid(pid, 0)[1]


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
        assert os.WIFSIGNALED(die(hasty, 60))
    with pytest.raises(TaskTimeoutError, match=r"stopped 2 times.*test_batch\.py"):
        kill_on_timeout(hasty).__enter__()
    assert list(tmp_path.iterdir()) == []
