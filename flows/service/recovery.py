"""Runs whose process was killed begin again: the store holds what they had finished.

Prefect alone shows them as running for ever. An automation on its heartbeats would not do: it knows
events, not states, and takes a run that waits for people for one that was killed.
"""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterName,
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import FlowRun, State, StateType
from prefect.events.filters import (
    EventFilter,
    EventNameFilter,
    EventOccurredFilter,
    EventResourceFilter,
)
from prefect.states import Cancelled, Crashed, Scheduled

from flows.cluster_errors import LostWorkersError
from flows.service.layout import is_alive
from flows.service.plan import ServePlan

SILENT: Final = timedelta(seconds=90)
"""A run that gave no sign of life for so long is looked after; they come every 30 s."""
STARTING: Final = timedelta(minutes=5)
"""What the process of a run may take until the run is at work, on a machine with too much to do."""
MOST_BEGINNINGS: Final = 3
"""A run that was killed so often is left crashed, for a person to look at."""
AT_WORK: Final = (StateType.RUNNING, StateType.PENDING, StateType.CANCELLING)
KILLED: Final = "its process was killed"

LOG = logging.getLogger("worldpose.operations")


async def begin_again(plan: ServePlan, *, at_start: bool = False) -> list[str]:
    """Schedule runs that were killed or lost their machines once more; gives their names.

    Args:
        plan: what is served.
        at_start: nothing runs yet, so that with a Prefect server of our own even what seems to be
            at work was killed with the service before.
    """
    again = []
    async with get_client() as client:
        if at_start and plan.owns_prefect:
            for run in await _runs(client, plan, *AT_WORK):
                was_cancelled = run.state_type == StateType.CANCELLING
                state: State[Any] = Cancelled() if was_cancelled else Crashed(message=KILLED)
                await client.set_flow_run_state(run.id, state, force=True)
        else:
            for run in await _runs(client, plan, StateType.RUNNING, StateType.PENDING):
                if await _is_dead(client, plan, run):
                    await client.set_flow_run_state(run.id, Crashed(message=KILLED), force=True)
        for run in await _runs(client, plan, StateType.CRASHED, StateType.FAILED):
            if may_begin_again(run):
                why = KILLED if run.state_type == StateType.CRASHED else "its machines were lost"
                LOG.warning("%s: %s; it begins again", run.name, why)
                state = Scheduled(name="AwaitingRetry", message=why)
                await client.set_flow_run_state(run.id, state, force=True)
                again.append(run.name)
    return again


def may_begin_again(run: FlowRun) -> bool:
    """Whether a run ended by no fault of its own: it was killed, or its machines were lost."""
    if run.state is None or run.run_count >= MOST_BEGINNINGS:
        return False
    was_lost = LostWorkersError.__name__ in (run.state.message or "")
    return run.state_type == StateType.CRASHED or (run.state_type == StateType.FAILED and was_lost)


async def _is_dead(client: PrefectClient, plan: ServePlan, run: FlowRun) -> bool:
    """Whether a run that seems to run or start has no process and gave no sign of life lately.

    A run is left starting if its process was killed while the server could not be told, on a full
    disk for instance. It would keep its place in the pool from all others.
    """
    is_starting = run.state_type == StateType.PENDING
    since = datetime.now(UTC) - (STARTING if is_starting else SILENT)
    if run.state is None or run.state.timestamp > since:
        return False
    pid = str(run.infrastructure_pid or "").rpartition(":")[2]
    if plan.owns_prefect and pid.isdigit():  # all processes are on this machine
        return not is_alive(int(pid))
    signs = await client.read_events(
        EventFilter(
            event=EventNameFilter(name=["prefect.flow-run.heartbeat"]),
            resource=EventResourceFilter(id=[f"prefect.flow-run.{run.id}"]),
            occurred=EventOccurredFilter(since=since),
        ),
        limit=1,
    )
    return not signs.events


async def _runs(client: PrefectClient, plan: ServePlan, *states: StateType) -> list[FlowRun]:
    return await client.read_flow_runs(
        flow_run_filter=FlowRunFilter(
            state=FlowRunFilterState(type=FlowRunFilterStateType(any_=list(states)))
        ),
        deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[plan.name])),
    )
