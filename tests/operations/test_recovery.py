"""Runs that restart automatically."""

from datetime import UTC, datetime, timedelta

import pytest

from flows.service import recovery
from flows.service.match_runs import MatchRuns
from flows.service.plan import ServePlan
from flows.service.recovery import DEATHS, MOST_BEGINNINGS, MOST_SERVICE_DEATHS, may_restart

LOST = "Flow run encountered an exception: LostWorkersError: the Dask scheduler was lost"
KILLED = "its process was killed"


def ended(kind, message=KILLED, count=1, labels=None):
    state = {"type": kind, "message": message}
    return {"state": state, "state_type": kind, "run_count": count, "labels": labels}


@pytest.mark.parametrize(
    ("run", "again"),
    [
        (ended("CRASHED"), True),
        (ended("FAILED", LOST), True),
        (ended("FAILED", "Flow run encountered an exception: IncompleteRunError"), False),
        (ended("COMPLETED"), False),
        (ended("CRASHED", count=MOST_BEGINNINGS), False),
        # A start that ended with the whole service does not count.
        (ended("CRASHED", count=MOST_BEGINNINGS, labels={DEATHS: 1}), True),
        (ended("CRASHED", count=MOST_BEGINNINGS + 1, labels={DEATHS: 1}), False),
        (ended("CRASHED", count=MOST_BEGINNINGS + MOST_SERVICE_DEATHS, labels={DEATHS: 99}), False),
    ],
)
def test_runs_begin_again_that_ended_by_no_fault_of_their_own(run, again):
    assert may_restart(run) is again


@pytest.mark.parametrize("is_alive", [False, True])
@pytest.mark.parametrize(
    ("kind", "minutes", "is_due"),
    [("RUNNING", 1, False), ("RUNNING", 2, True), ("PENDING", 4, False), ("PENDING", 6, True)],
)
def test_a_run_whose_process_is_gone_begins_again_also_while_it_starts(
    kind, minutes, is_due, is_alive, monkeypatch, tmp_path
):
    at = (datetime.now(UTC) - timedelta(minutes=minutes)).isoformat()
    run = {**ended(kind), "id": "1f2e", "name": "inbox", "expected_start_time": at}
    run["state"]["timestamp"], run["infrastructure_pid"] = at, "4711"
    given = []

    def set_state(prefect, run_id, kind, message, name=None):
        given.append(name or kind)
        run["state"]["type"] = run["state_type"] = kind

    def runs(prefect, names, *, state):
        return [run] if run["state_type"] in state["type"]["any_"] else []

    monkeypatch.setattr(MatchRuns, "set_state", set_state)
    monkeypatch.setattr(MatchRuns, "runs", runs)
    monkeypatch.setattr(recovery, "is_alive", lambda pid: pid == 4711 and is_alive)
    api = "http://127.0.0.1:9/api"
    plan = ServePlan(project=str(tmp_path), inbox=tmp_path, state=tmp_path, prefect=api)
    again = recovery.restart_lost_runs(plan)
    expected = is_due and not is_alive
    assert again == (["inbox"] if expected else [])
    assert given == (["CRASHED", "AwaitingRetry"] if expected else [])
