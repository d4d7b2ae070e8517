"""The real machinery: embedded, with a Prefect server, with a Dask cluster of its own processes."""

import json
import os
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from command_line import TINY, succeed, worldpose

from flows.orchestration.prefect_environment import CLIENT_LOGIN, authorization
from worldpose.store.store import Store

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
    joints = ("--until", "triangulation")
    succeed("run", tiny, "--project", project, *joints, environment=environment)
    assert not notes.exists(), notes.read_text()


def test_a_run_is_visible_at_the_server_by_name(server, tiny, tmp_path):
    succeed("run", tiny, "--project", tmp_path / "worldpose-data", "--until", "triangulation")

    def ask(kind):
        request = urllib.request.Request(
            f"{server}/{kind}/filter",
            data=b'{"sort": "EXPECTED_START_TIME_DESC", "limit": 50}',
            headers={
                "content-type": "application/json",
                "authorization": authorization(os.environ[CLIENT_LOGIN]),
            },
        )
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)

    run = ask("flow_runs")[0]
    assert (run["name"], run["state_name"]) == (TINY, "Completed")
    assert run["parameters"]["match_id"] == TINY
    tasks = {task["name"] for task in ask("task_runs") if task["flow_run_id"] == run["id"]}
    assert {"tracking clip", "triangulation clip"} <= tasks


@pytest.mark.slow
def test_a_damaged_input_fails_its_unit_and_repair_mends_it(server, tiny, tmp_path):
    project = tmp_path / "worldpose-data"
    succeed("run", tiny, "--project", project, "--until", "tracking")
    chunks = (project / "results" / TINY / "tracking").rglob("detection_index/c/*/*/*")
    chunk = next(path for path in chunks if path.is_file())
    spoilt = bytearray(chunk.read_bytes())
    spoilt[-1] ^= 1
    chunk.write_bytes(spoilt)
    joints = ("--until", "triangulation")
    answer = worldpose("run", tiny, "--project", project, *joints)
    assert answer.code == 1
    assert "triangulation/clip" in answer.err
    assert "detection_index" in answer.err
    record = Store.open(str(project)).run(TINY)
    assert record.state == "failed"
    assert [failure.unit for failure in record.failed] == ["triangulation/clip"]
    lost = succeed("why", f"{TINY}/tracking/clip", "--project", project, "--json").json
    assert lost["state"] == "current"
    # Mending it: the damaged result is withdrawn and computed again.
    assert worldpose("verify", "--repair", "--project", project).code == 1
    lost = succeed("why", f"{TINY}/tracking/clip", "--project", project, "--json").json
    assert lost["state"] == "missing"
    status = succeed("status", "--project", project, "--json").json["matches"][0]["units"]
    assert status["missing"] == [
        "tracking/clip",
        "triangulation/clip",
        "bundle_adjustment/cameras",
        "retriangulation/clip",
        "body_fitting/clip",
        "filtering/clip",
    ]
    again = succeed("run", tiny, "--project", project, *joints, "--json").json
    assert (again["executed"], again["failed"]) == (2, 0)
