"""Killed anywhere, run again: the store is that of an undisturbed run, byte for byte."""

import json
import os
import subprocess
import time
from pathlib import Path

import pytest
from checker import problems_of
from command_line import TINY, WORLDPOSE, succeed, worldpose

from worldpose.store.blobs import COMMIT_POINTS
from worldpose.store.store import Store

pytestmark = [pytest.mark.usefixtures("server"), pytest.mark.faults]

FAULT = Path(__file__).with_name("fault.py")
IN_WORKER = [point for point in COMMIT_POINTS if "run_record" not in point]


def planned(**plan):
    environment = {"DASK_DISTRIBUTED__WORKER__PRELOAD": str(FAULT)}
    return environment | {"WORLDPOSE_TEST_FAULT": json.dumps(plan)}


def fault_environment(tmp_path, point, **plan):
    struck = tmp_path / "struck"
    return planned(point=point, struck=str(struck), **plan), struck


def assert_same_store(project, undisturbed):
    assert problems_of(project, undisturbed) == []


@pytest.mark.slow
@pytest.mark.parametrize("point", IN_WORKER)
def test_a_worker_killed_at_a_commit_point_is_replaced(point, tiny, tiny_run, tmp_path):
    # Two workers share more than a dozen units, so one of them comes to the point a third time.
    environment, struck = fault_environment(tmp_path, point, skip=2)
    project = tmp_path / "worldpose-data"
    succeed("run", tiny, "--project", project, "--workers", 2, environment=environment)
    assert struck.exists(), "the fault did not strike"
    assert_same_store(project, tiny_run)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "error", "said"),
    [
        # A worker's first unit took 5 s on two busy cores.
        ("hang", "TaskTimeoutError", "stopped 2 times, each time after 0.5 minutes"),
        ("die", "WorkerCrashError", "its process ended 3 times"),
    ],
)
def test_a_deadly_unit_is_given_up_and_named_and_the_others_finish(
    how, error, said, tiny, tmp_path
):
    project, unit = tmp_path / "worldpose-data", "ingest/cam01"
    limited = ("--until", "ingest", "--time-limit", 0.5)
    spoilt = planned(unit=unit, how=how)
    answer = worldpose("run", tiny, "--project", project, *limited, environment=spoilt)
    assert answer.code == 4, answer.err
    record = Store.open(str(project)).run(TINY)
    (failure,) = record.failed
    assert (record.state, failure.unit, failure.error) == ("partial", unit, error)
    assert said in failure.message
    if how == "hang":
        assert "fault.py" in failure.message, "it is not said where it hung"
    assert len(record.executed) == len(record.results) == 6
    again = worldpose("run", tiny, "--project", project, "--until", "ingest", "--json")
    assert (again.code, again.json["executed"]) == (0, 1)


def test_workers_and_server_end_with_a_killed_run(tiny, tmp_path):
    marker = f"WORLDPOSE_TEST_MARK={tmp_path.name}"
    environment = {**os.environ, "WORLDPOSE_TEST_MARK": tmp_path.name}
    environment.pop("PREFECT_API_URL")  # so that it brings a server of its own
    process = run_until(b"ingest:", tiny, tmp_path, environment)  # server and workers are up
    assert len(processes_with(marker)) > 2
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20
    while processes_with(marker) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert processes_with(marker) == []


def run_until(word, match, folder, environment):
    """A run, leading a process group of its own, that has said so much."""
    process = subprocess.Popen(
        [*WORLDPOSE, "run", str(match), "--project", str(folder / "worldpose-data")],
        start_new_session=True,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    assert any(word in line for line in process.stderr)
    return process


def processes_with(marker):
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            running = "\nState:\tZ" not in (folder / "status").read_text()
            if running and marker.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return [pid for pid in found if pid != os.getpid()]
