"""Health checks name each fault with its remedy."""

import os
from datetime import UTC, datetime, timedelta

import pytest

from data_contracts.operations import Arrival, Service, Serving
from flows.orchestration.prefect_api import PrefectApi
from flows.orchestration.prefect_environment import CLIENT_LOGIN
from flows.service import health
from flows.service.health import check
from flows.service.layout import StateFolder
from flows.service.plan import FLOWS, deployment_name


@pytest.fixture
def state(tmp_path):
    return StateFolder(tmp_path / "operations")


def serving(tmp_path, prefect, **services):
    return Serving(
        project=str(tmp_path),
        inbox=str(tmp_path / "inbox"),
        name="healthy",
        prefect=prefect,
        owns_prefect=False,
        services={"serve": Service(pid=os.getpid()), **services},
        started_at=datetime.now(UTC),
    )


def by_part(findings):
    return {finding.part: finding for finding in findings}


def test_what_was_never_started_or_killed_is_said(state, tmp_path):
    (finding,) = check(state)
    assert (finding.part, finding.is_well) == ("serve", False)
    assert "not started" in finding.state
    state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
    (finding,) = check(state)
    assert "killed" in finding.state
    assert "worldpose serve" in finding.remedy


def test_every_part_that_is_not_well_says_how_to_mend_it(server, state, tmp_path, monkeypatch):
    dead = Service(pid=2**22 + 1, address="http://127.0.0.1:9")
    state.write_serving(serving(tmp_path, server, pages=dead))
    monkeypatch.setattr(health, "LOW_DISK_GB", 1e9)
    with state.only_one("serve", wait=False):
        found = by_part(check(state))
        assert {part for part, each in found.items() if each.is_well} == {"serve", "prefect"}
        assert "match" in found["deployments"].state
        assert "worker.log" in found["worker of healthy"].remedy
        assert "pages.log" in found["pages"].remedy
        assert "inbox" in found["inbox"].remedy
        assert "worldpose gc" in found["disk"].remedy
        assert all(each.remedy for each in found.values() if not each.is_well)
        # Another login, and without the server: deployments are unknown.
        with monkeypatch.context() as other:
            other.setenv(CLIENT_LOGIN, "worldpose:wrong")
            assert CLIENT_LOGIN in by_part(check(state))["deployments"].remedy
        state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
        (tmp_path / "inbox").mkdir()
        for name, seen in (("a", "taken"), ("b", "refused"), ("c", "refused")):
            state.write_arrival(Arrival(name=name, state=seen, changed_at=datetime.now(UTC)))
        found = by_part(check(state))
        assert "Start the Prefect server" in found["prefect"].remedy
        assert found["deployments"].remedy == "Fix prefect first."
        inbox = found["inbox"]
        assert (inbox.is_well, inbox.state) == (True, "3 known, 2 refused")


class Prefect:
    """Answers of a healthy Prefect server."""

    def __init__(self):
        names = [deployment_name("healthy", flow) for flow in FLOWS]
        self.asked = {}
        self.answers = {
            **{f"/deployments/name/{name}": {"name": name} for name in names},
            **{f"/work_pools/{pool}": {} for pool in ("healthy", "healthy-arrivals")},
            "/work_pools/healthy/workers/filter": workers(1.0),
            "/work_pools/healthy-arrivals/workers/filter": workers(1.0),
            "/flow_runs/count": 0,
        }

    def ask(self, api, path, body=None):
        self.asked[path] = body
        return self.answers[path]


def workers(*silent):
    """Workers that were heard of so long ago [s]."""
    now = datetime.now(UTC)
    beats = [(now - timedelta(seconds=each)).isoformat() for each in silent]
    return [{"last_heartbeat_time": beat.replace("+00:00", "Z")} for beat in beats]


@pytest.fixture
def prefect(monkeypatch):
    prefect = Prefect()
    monkeypatch.setattr(PrefectApi, "ask", lambda api, *given: prefect.ask(api, *given))
    return prefect


def at_prefect(tmp_path):
    return by_part(health.at_prefect(serving(tmp_path, "http://127.0.0.1:4200/api"), None))


@pytest.mark.parametrize(
    ("silent", "is_well", "said"),
    [
        ([80.0], True, "80 s ago"),
        ([100.0], False, "100 s ago"),  # it reports every 30 s
        ([5000.0, 20.0], True, "20 s ago"),
        ([], False, "never heard of"),
    ],
)
def test_of_the_workers_of_a_pool_one_has_to_be_heard_of(prefect, tmp_path, silent, is_well, said):
    prefect.answers["/work_pools/healthy-arrivals/workers/filter"] = workers(*silent)
    found = at_prefect(tmp_path)
    worker = found.pop("worker of healthy-arrivals")
    assert (worker.is_well, said in worker.state) == (is_well, True)
    assert {part: each.is_well for part, each in found.items()} == {
        "deployments": True,
        "worker of healthy": True,
    }


def test_runs_that_run_for_more_than_a_day_are_told(prefect, tmp_path):
    prefect.answers["/flow_runs/count"] = 2
    runs = at_prefect(tmp_path)["runs"]
    assert (runs.is_well, runs.state) == (False, "2 seem to run for more than a day")
    assert "http://127.0.0.1:4200, and cancel" in runs.remedy
    asked = prefect.asked["/flow_runs/count"]["flow_runs"]
    before = datetime.fromisoformat(asked["expected_start_time"]["before_"])
    # A minute for a slow machine.
    assert 0.0 <= (datetime.now(UTC) - before).total_seconds() - 86_400.0 < 60.0
