"""Restart of runs whose process was killed: the store holds their finished results.

Prefect alone shows them as running forever. An automation on its heartbeats would not work: it uses
events, not states, and cannot tell a suspended run from a killed one.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from flows.orchestration.cluster_errors import LostWorkersError
from flows.orchestration.prefect_api import PrefectApi, of_types, parse_time
from flows.service.layout import is_alive
from flows.service.match_runs import MatchRuns
from flows.service.plan import ServePlan, deployment_names
from flows.service.schedules import list_missed

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
ENDED_BADLY: Final = ("CRASHED", "FAILED")
KILLED: Final = "its process was killed"

LOG = logging.getLogger("worldpose.operations")

PrefectRun = Mapping[str, Any]
"""A flow run as Prefect's API describes it."""


def restart_lost_runs(
    plan: ServePlan, *, at_start: bool = False, since: datetime | None = None
) -> list[str]:
    """Reschedule runs that were killed or lost their machines; return their names.

    At the start no run is active yet: with a Prefect server of our own, even an apparently active
    run was killed with the previous service. Runs that ended before `since` were seen by a previous
    call.
    """
    prefect, deployments = MatchRuns.of_plan(plan), deployment_names(plan.name)
    list_missed(prefect, deployments)  # of a machine that slept: each schedule runs once
    if at_start and plan.owns_prefect:
        for run in prefect.runs(deployments, state=of_types("RUNNING", "PENDING", "CANCELLING")):
            if run["state_type"] == "RUNNING":
                deaths = {DEATHS: _service_deaths(run) + 1}
                prefect.ask(f"/flow_runs/{run['id']}/labels", deaths, method="PATCH")
            was_cancelled = run["state_type"] == "CANCELLING"
            prefect.set_state(run["id"], "CANCELLED" if was_cancelled else "CRASHED", KILLED)
    else:
        for run in prefect.runs(deployments, state=of_types("RUNNING", "PENDING")):
            if _is_dead(prefect, plan, run):
                prefect.set_state(run["id"], "CRASHED", KILLED)
    wanted: dict[str, Any] = {"state": of_types(*ENDED_BADLY)}
    if since is not None:
        wanted["end_time"] = {"after_": since.isoformat()}
    lost = [run for run in prefect.runs(deployments, **wanted) if may_restart(run)]
    lost.sort(key=lambda run: run["expected_start_time"] or "")  # that has waited longest first
    for run in lost:
        why = KILLED if run["state_type"] == "CRASHED" else "its machines were lost"
        LOG.warning("%s: %s; it restarts", run["name"], why)
        prefect.set_state(run["id"], "SCHEDULED", why, "AwaitingRetry")
    return [run["name"] for run in lost]


def may_restart(run: PrefectRun) -> bool:
    """Return whether a run may restart: its process was killed, or its machines were lost."""
    own_starts = run["run_count"] - min(_service_deaths(run), MOST_SERVICE_DEATHS)
    if run["state"] is None or own_starts >= MOST_BEGINNINGS:
        return False
    was_lost = LostWorkersError.__name__ in (run["state"]["message"] or "")
    return run["state_type"] == "CRASHED" or (run["state_type"] == "FAILED" and was_lost)


def _service_deaths(run: PrefectRun) -> int:
    return int((run["labels"] or {}).get(DEATHS) or 0)


def _is_dead(prefect: PrefectApi, plan: ServePlan, run: PrefectRun) -> bool:
    """Return whether an active or starting run has no process and no recent heartbeat.

    A run stays in a starting state if its process was killed while the server was not reachable or
    its disk was full. It would occupy a slot of the pool forever.
    """
    since = datetime.now(UTC) - (STARTING if run["state_type"] == "PENDING" else SILENT)
    if run["state"] is None or parse_time(run["state"]["timestamp"]) > since:
        return False
    pid = str(run["infrastructure_pid"] or "")
    if plan.owns_prefect and pid.isdigit():  # all processes are on this machine
        return not is_alive(int(pid))
    heartbeats = {
        "event": {"name": ["prefect.flow-run.heartbeat"]},
        "resource": {"id": [f"prefect.flow-run.{run['id']}"]},
        "occurred": {"since": since.isoformat()},
    }
    return not prefect.ask("/events/filter", {"filter": heartbeats, "limit": 1})["events"]
