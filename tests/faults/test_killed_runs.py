"""Killed anywhere, run again: the store is that of an undisturbed run, byte for byte."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from checker import half_written, problems_of
from command_line import WORLDPOSE, succeed

from worldpose.store.blobs import COMMIT_POINTS

pytestmark = [pytest.mark.usefixtures("server"), pytest.mark.faults]

FAULT = Path(__file__).with_name("fault.py")
IN_WORKER = [point for point in COMMIT_POINTS if "run_record" not in point]
IN_MAIN = [point for point in COMMIT_POINTS if "run_record" in point]


def fault_environment(tmp_path, point, **plan):
    struck = tmp_path / "struck"
    plan = json.dumps({"point": point, "struck": str(struck), **plan})
    return {"WORLDPOSE_TEST_FAULT": plan, "DASK_DISTRIBUTED__WORKER__PRELOAD": str(FAULT)}, struck


def assert_same_store(project, undisturbed):
    assert problems_of(project, undisturbed) == []


def quick(points, kept):
    """All points, but only some of them in the quick tier."""
    return [
        point if point in kept else pytest.param(point, marks=pytest.mark.slow) for point in points
    ]


@pytest.mark.parametrize("point", quick(IN_WORKER, {"before_commit"}))
def test_a_worker_killed_at_a_commit_point_is_replaced(point, tiny, tiny_run, tmp_path):
    # Two workers share more than a dozen units, so one of them comes to the point a third time.
    environment, struck = fault_environment(tmp_path, point, skip=2)
    project = tmp_path / "worldpose-data"
    succeed("run", tiny, "--project", project, "--workers", 2, environment=environment)
    assert struck.exists(), "the fault did not strike"
    assert_same_store(project, tiny_run)


@pytest.mark.slow
@pytest.mark.parametrize("point", IN_MAIN)
def test_the_whole_process_killed_around_the_run_record(point, tiny, tiny_run, tmp_path):
    environment, struck = fault_environment(tmp_path, point)
    project = tmp_path / "worldpose-data"
    killed = subprocess.run(
        [sys.executable, FAULT, "run", tiny, "--project", project],
        env={**os.environ, **environment},
        capture_output=True,
    )
    assert killed.returncode == -signal.SIGKILL
    assert struck.exists()
    succeed("run", tiny, "--project", project)
    assert_same_store(project, tiny_run)


@pytest.mark.slow
@pytest.mark.parametrize("point", IN_WORKER)
def test_the_whole_process_group_killed_at_a_commit_point(point, tiny, tiny_run, tmp_path):
    environment, struck = fault_environment(tmp_path, point, skip=1, whole_group=True)
    project = tmp_path / "worldpose-data"
    process = start_run(tiny, project, environment)
    assert process.wait() == -signal.SIGKILL
    assert struck.exists()
    assert_nothing_half_written(project)
    succeed("run", tiny, "--project", project)
    assert_same_store(project, tiny_run)


def start_run(match, project, environment):
    """A run of two workers, leading a process group of its own."""
    return subprocess.Popen(
        [*WORLDPOSE, "run", str(match), "--project", str(project), "--workers", "2"],
        start_new_session=True,
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def assert_nothing_half_written(project):
    assert half_written(project) == [], "something half-written can be read"


def test_workers_and_server_end_with_a_killed_run(tiny, tmp_path):
    marker = f"WORLDPOSE_TEST_MARK={tmp_path.name}"
    environment = {**os.environ, "WORLDPOSE_TEST_MARK": tmp_path.name}
    environment.pop("PREFECT_API_URL")  # so that it brings a server of its own
    process = subprocess.Popen(
        [*WORLDPOSE, "run", str(tiny), "--project", str(tmp_path / "worldpose-data")],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    for line in process.stderr:
        if b"tracking" in line:  # server and workers are up
            break
    assert len(processes_with(marker)) > 2
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20
    while processes_with(marker) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert processes_with(marker) == []


def processes_with(marker):
    """Ids of live processes that have this in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            running = "\nState:\tZ" not in (folder / "status").read_text()
            if running and marker.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return [pid for pid in found if pid != os.getpid()]


@pytest.mark.slow
def test_a_terminated_run_ends_at_once_and_goes_on_with_the_same_command(tiny, tmp_path):
    """Ctrl-C: tests/flows/test_progress.py."""
    environment = {**os.environ, "WORLDPOSE_TEST_MARK": tmp_path.name}
    environment.pop("PREFECT_API_URL")
    process = subprocess.Popen(
        [*WORLDPOSE, "run", str(tiny), "--project", str(tmp_path / "worldpose-data")],
        start_new_session=True,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    for line in process.stderr:
        if "ingest:" in line:
            break
    os.killpg(process.pid, signal.SIGTERM)
    started = time.monotonic()
    _, said = process.communicate(timeout=60)
    # It goes through Prefect, which took 3 s.
    assert time.monotonic() - started < 30
    assert process.returncode not in (0, None)
    assert "Traceback" not in said, said
    succeed("run", tiny, "--project", tmp_path / "worldpose-data", "--until", "tracking")
