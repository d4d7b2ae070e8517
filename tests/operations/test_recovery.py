"""Runs that restart automatically."""

import asyncio
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from uuid import uuid4

import pytest
from prefect.client.schemas.objects import FlowRun
from prefect.states import Completed, Crashed, Failed, Pending, Running

from flows.service import recovery
from flows.service.recovery import (
    DEATHS,
    MOST_BEGINNINGS,
    MOST_SERVICE_DEATHS,
    may_restart,
)

LOST = "Flow run encountered an exception: LostWorkersError: the Dask scheduler was lost"


@pytest.mark.parametrize(
    ("state", "again"),
    [
        (Crashed(message="its process was killed"), True),
        (Failed(message=LOST), True),
        (Failed(message="Flow run encountered an exception: IncompleteRunError: 1 failed"), False),
        (Completed(), False),
    ],
)
def test_runs_begin_again_that_ended_by_no_fault_of_their_own(state, again):
    run = FlowRun(flow_id=uuid4(), state=state, state_type=state.type, run_count=1)
    assert may_restart(run) is again
    tired = run.model_copy(update={"run_count": MOST_BEGINNINGS})
    assert not may_restart(tired)


def test_a_start_that_ended_with_the_whole_service_does_not_count():
    state = Crashed(message="its process was killed")
    run = FlowRun(flow_id=uuid4(), state=state, state_type=state.type, run_count=MOST_BEGINNINGS)
    assert not may_restart(run)
    killed = run.model_copy(update={"labels": {DEATHS: 1}})
    assert may_restart(killed)
    assert not may_restart(killed.model_copy(update={"run_count": MOST_BEGINNINGS + 1}))
    often = {"labels": {DEATHS: 99}, "run_count": MOST_BEGINNINGS + MOST_SERVICE_DEATHS}
    assert not may_restart(run.model_copy(update=often))


class Server:
    """A Prefect server with one run, whose process is gone or at work."""

    def __init__(self, run):
        self.run, self.given = run, []

    async def __aenter__(self):
        return self

    async def __aexit__(self, *error):
        pass

    async def read_flow_runs(self, *, flow_run_filter, **page):
        return [self.run] if self.run.state_type in flow_run_filter.state.type.any_ else []

    async def set_flow_run_state(self, flow_run_id, state, *, force):
        self.given.append(state.name)
        self.run = self.run.model_copy(update={"state": state, "state_type": state.type})


@pytest.mark.parametrize("is_alive", [False, True])
@pytest.mark.parametrize(
    ("kind", "minutes", "is_due"),
    [(Running, 1, False), (Running, 2, True), (Pending, 4, False), (Pending, 6, True)],
)
def test_a_run_whose_process_is_gone_begins_again_also_while_it_starts(
    kind, minutes, is_due, is_alive, monkeypatch
):
    at = datetime.now(UTC) - timedelta(minutes=minutes)
    state = kind().model_copy(update={"timestamp": at})
    run = FlowRun(flow_id=uuid4(), name="inbox", state=state, state_type=state.type, run_count=1)
    server = Server(run.model_copy(update={"infrastructure_pid": "host:4711"}))
    monkeypatch.setattr(recovery, "get_client", lambda: server)
    monkeypatch.setattr(recovery, "is_alive", lambda pid: pid == 4711 and is_alive)
    plan = SimpleNamespace(owns_prefect=True, name="worldpose")
    again = asyncio.run(recovery.restart_lost_runs(plan))
    expected = is_due and not is_alive
    assert again == (["inbox"] if expected else [])
    assert server.given == (["Crashed", "AwaitingRetry"] if expected else [])
