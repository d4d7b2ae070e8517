"""The one way in which a served project runs a match: a run of its Prefect deployment.

Pages, inbox and schedules ask for such runs here, and Prefect's own form creates them there: all
have the worker, queues, limits and links of the deployment.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from urllib.parse import quote

from pydantic import JsonValue

from data_contracts.operations import Priority, QueuedRun
from flows.orchestration.prefect_api import PrefectApi, UnreachablePrefectError
from flows.orchestration.prefect_environment import CLIENT_LOGIN
from flows.service.layout import is_alive, served_state
from flows.service.plan import TITLES, ServePlan, deployment_name
from flows.service.run_queue import queued_run
from worldpose.store.run_queue import RunQueue, queue_of


@dataclass(frozen=True)
class MatchRuns(PrefectApi):
    """Runs of one served project: its queue, and the Prefect server that starts them.

    `pages` is the address of the review pages, to which runs link; empty if unknown.
    """

    name: str = "worldpose"
    pages: str = ""
    project: str = ""

    @classmethod
    def of_plan(cls, plan: ServePlan) -> MatchRuns:
        """Return the runs of a served project for one of its processes, which has the login."""
        login = os.environ.get(CLIENT_LOGIN)
        return cls(plan.prefect, login, name=plan.name, pages=plan.pages, project=plan.project)

    @property
    def queue(self) -> RunQueue:
        """The project's queue."""
        return queue_of(self.project)

    def start(
        self,
        match_id: str,
        *,
        priority: Priority = "normal",
        key: str = "",
        **parameters: JsonValue,
    ) -> QueuedRun:
        """Ask for a run of a match, as `ask_for`; None stands for the default of a parameter."""
        given = {name: value for name, value in parameters.items() if value is not None}
        return self.ask_for("match", {"match_id": match_id, **given}, priority=priority, key=key)

    def ask_for(
        self,
        flow: str,
        parameters: Mapping[str, JsonValue],
        *,
        what: str = "",
        priority: Priority | None = None,
        key: str = "",
    ) -> QueuedRun:
        """Ask for a run of a deployment, which the worker starts in its turn.

        A second call with the same key returns the run of the first. UnreachablePrefectError if no
        run was created.
        """
        for known in self.queue.runs(f"queue/{flow}") if key else ():
            if known.key == key:
                return known
        name = run_name(what or title_of(flow, parameters))
        # A request that is repeated after a lost answer creates no second run.
        created = self.create_run(flow, name, parameters, priority, key or f"once-{uuid.uuid4()}")
        return self.queue.take(queued_run(flow, created))

    def create_run(
        self,
        flow: str,
        name: str,
        parameters: Mapping[str, JsonValue],
        priority: Priority | None,
        key: str,
    ) -> dict[str, Any]:
        """Create a run at Prefect, by one idempotency key only once; return Prefect's answer."""
        run = {"name": name, "parameters": dict(parameters), "idempotency_key": key}
        if priority is not None:
            run |= {"tags": [priority], "work_queue_name": priority}
        deployment = self.ask(f"/deployments/name/{quote(deployment_name(self.name, flow))}")
        created: dict[str, Any] = self.ask(f"/deployments/{deployment['id']}/create_flow_run", run)
        return created

    def at_prefect(self, runs: Iterable[QueuedRun]) -> dict[str, dict[str, Any]]:
        """Return what Prefect knows of runs, by its ids."""
        ids, size = [run.flow_run for run in runs], 100  # of a request
        some = (ids[first : first + size] for first in range(0, len(ids), size))
        found = (self.list_all("flow_runs", flow_runs={"id": {"any_": each}}) for each in some)
        return {run["id"]: run for each in found for run in each}

    def cancel(self, run: QueuedRun, why: str) -> bool:
        """End a run, or take it out of the queue; return False if it has ended.

        The queue decides: a process that has read Prefect's state would overwrite it. The worker
        ends the process of a run that the queue calls cancelled, and Prefect is told later if it
        does not answer.
        """
        ended = self.queue.cancel(run, why)
        if ended is None:
            return False
        with suppress(UnreachablePrefectError):
            if self.find(f"/flow_runs/{ended.flow_run}") is not None:
                self.set_state(ended.flow_run, "CANCELLED", why)
        return True

    def link(self, run: QueuedRun) -> str:
        """Return the page of a run in Prefect's dashboard."""
        return f"{self.api.removesuffix('/api')}/runs/flow-run/{run.flow_run}"


def run_name(what: str, at: datetime | None = None) -> str:
    """Return the name of a run: what it processes, and its time, by default now."""
    return f"{what}, {(at or datetime.now()).astimezone():%d %b %H:%M:%S}"


def title_of(flow: str, parameters: Mapping[str, Any]) -> str:
    """Return what a run processes: its match, or the title of its flow."""
    return str(parameters.get("match_id") or TITLES.get(flow, flow))


def match_runs_of(url: str) -> MatchRuns | None:
    """Return the runs of a project that a service on this machine serves now; None without one."""
    state = served_state(url)
    serving = state.read_serving()
    if serving is None or "serve" not in serving.services:
        return None
    # Another process can have its number: the lock tells.
    if not is_alive(serving.services["serve"].pid) or not state.is_held("serve"):
        return None
    pages = serving.services.get("pages")
    address = "" if pages is None else pages.address or ""
    login = state.client_login(serving)
    return MatchRuns(
        serving.prefect, login, name=serving.name, pages=address, project=serving.project
    )
