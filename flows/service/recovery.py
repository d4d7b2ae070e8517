"""Restart of runs whose process was killed: the store holds their finished results.

Prefect alone shows them as running forever. An automation on its heartbeats would not work: it uses
events, not states, and cannot tell a suspended run from a killed one.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterName,
    FlowRunFilter,
    FlowRunFilterEndTime,
    FlowRunFilterState,
    FlowRunFilterStateType,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, State, StateType
from prefect.client.schemas.sorting import FlowRunSort
from prefect.events.filters import (
    EventFilter,
    EventNameFilter,
    EventOccurredFilter,
    EventResourceFilter,
)
from prefect.states import Cancelled, Crashed, Scheduled
from prefect.types import KeyValueLabels

from flows.orchestration.cluster_errors import LostWorkersError
from flows.orchestration.result_pages import PAGE, page_offsets
from flows.service.layout import is_alive
from flows.service.plan import TITLES, ServePlan, deployment_name, deployment_names

SILENT: Final = timedelta(seconds=90)
"""Without a heartbeat for so long, a run is checked; heartbeats come every 30 s."""
STARTING: Final = timedelta(minutes=5)
"""Maximum time from the start of a run's process until the run is active, on an overloaded
machine."""
MOST_BEGINNINGS: Final = 3
"""Number of starts after which a killed run stays crashed and needs an operator."""
MOST_SERVICE_DEATHS: Final = 10
"""Starts that do not count, because the whole service was killed; a run may be to blame for it."""
DEATHS: Final = "worldpose.service_deaths"
"""Label of a run: how often the service was killed while the run was active."""
AT_WORK: Final = (StateType.RUNNING, StateType.PENDING, StateType.CANCELLING)
ENDED_BADLY: Final = (StateType.CRASHED, StateType.FAILED)
KILLED: Final = "its process was killed"
EPOCH: Final = datetime.fromtimestamp(0, UTC)

LOG = logging.getLogger("worldpose.operations")


async def restart_lost_runs(
    plan: ServePlan, *, at_start: bool = False, since: datetime | None = None
) -> list[str]:
    """Reschedule runs that were killed or lost their machines; return their names.

    Args:
        plan: the served project.
        at_start: no run is active yet, so with a Prefect server of our own even an apparently
            active run was killed with the previous service.
        since: runs that ended earlier were seen by a previous call; None = none were.
    """
    again = []
    async with get_client() as client:
        if at_start and plan.owns_prefect:
            for run in await project_runs(client, plan, AT_WORK):
                was_cancelled = run.state_type == StateType.CANCELLING
                state: State[Any] = Cancelled() if was_cancelled else Crashed(message=KILLED)
                if run.state_type == StateType.RUNNING:
                    deaths: KeyValueLabels = {DEATHS: _service_deaths(run) + 1}
                    await client.update_flow_run_labels(run.id, deaths)
                await client.set_flow_run_state(run.id, state, force=True)
        else:
            active = (StateType.RUNNING, StateType.PENDING)
            for run in await project_runs(client, plan, active):
                if await _is_dead(client, plan, run):
                    await client.set_flow_run_state(run.id, Crashed(message=KILLED), force=True)
        ended = await project_runs(client, plan, ENDED_BADLY, ended_since=since)
        for run in reversed(ended):  # those that have waited longest first
            if may_restart(run):
                why = KILLED if run.state_type == StateType.CRASHED else "its machines were lost"
                LOG.warning("%s: %s; it restarts", run.name, why)
                state = Scheduled(name="AwaitingRetry", message=why)
                await client.set_flow_run_state(run.id, state, force=True)
                again.append(run.name)
    return again


async def name_scheduled_runs(plan: ServePlan) -> None:
    """Name the runs that Prefect has created for a schedule, which get random words from it."""
    async with get_client() as client:
        for flow in ("match", *TITLES):
            tags = FlowRunFilterTags(all_=["auto-scheduled"])
            for run in await project_runs(client, plan, (StateType.SCHEDULED,), flow, tags=tags):
                due = run.next_scheduled_start_time
                if run.auto_scheduled and due is not None:
                    title = run.parameters.get("match_id") or TITLES.get(flow, flow)
                    name = f"{title}, {due.astimezone():%d %b %H:%M:%S}"
                    if run.name != name:
                        await client.update_flow_run(run.id, name=name)


def may_restart(run: FlowRun) -> bool:
    """Return whether a run may restart: its process was killed, or its machines were lost."""
    own_starts = run.run_count - min(_service_deaths(run), MOST_SERVICE_DEATHS)
    if run.state is None or own_starts >= MOST_BEGINNINGS:
        return False
    was_lost = LostWorkersError.__name__ in (run.state.message or "")
    return run.state_type == StateType.CRASHED or (run.state_type == StateType.FAILED and was_lost)


def _service_deaths(run: FlowRun) -> int:
    return int(run.labels.get(DEATHS) or 0)


async def _is_dead(client: PrefectClient, plan: ServePlan, run: FlowRun) -> bool:
    """Return whether an active or starting run has no process and no recent heartbeat.

    A run stays in a starting state if its process was killed while the server was not reachable or
    its disk was full. It would occupy a slot of the pool forever.
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


async def project_runs(
    client: PrefectClient,
    plan: ServePlan,
    states: Sequence[StateType],
    flow: str | None = None,
    *,
    ended_since: datetime | None = None,
    tags: FlowRunFilterTags | None = None,
) -> list[FlowRun]:
    """Return all runs of the project's deployments in these states, newest first.

    Args:
        client: client of the Prefect server.
        plan: the served project.
        states: types of their states.
        flow: flow whose runs are returned; None = those of all flows.
        ended_since: earliest end of a run; None = any, or none.
        tags: condition on their tags.
    """
    names = deployment_names(plan.name)
    if flow is not None:
        names = [deployment_name(plan.name, flow).partition("/")[2]]
    found: list[FlowRun] = []
    for offset in page_offsets(found):
        found += await client.read_flow_runs(
            flow_run_filter=FlowRunFilter(
                state=FlowRunFilterState(type=FlowRunFilterStateType(any_=list(states))),
                end_time=None if ended_since is None else FlowRunFilterEndTime(after_=ended_since),
                tags=tags,
            ),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=names)),
            sort=FlowRunSort.ID_DESC,
            limit=PAGE,
            offset=offset,
        )
    unique = {run.id: run for run in found}.values()
    return sorted(unique, key=lambda run: run.expected_start_time or EPOCH, reverse=True)
