"""The one way in which a served project runs a match: a run of its Prefect deployment.

Pages, inbox and schedules create such runs here, and Prefect's own form creates them there: all
have the worker, queues, limits and links of the deployment.
"""

from __future__ import annotations

import logging
import os
import re
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final
from urllib.parse import quote

from pydantic import JsonValue

from data_contracts.operations import Priority
from flows.orchestration.prefect_api import (
    PrefectApi,
    of_types,
    parse_time,
)
from flows.orchestration.prefect_environment import CLIENT_LOGIN
from flows.run_record import runs_at_work
from flows.service.layout import is_alive, served_state
from flows.service.plan import TITLES, ServePlan, deployment_name
from worldpose.store.store import Store

LOG: Final = logging.getLogger("worldpose.operations")
LOOK_SECONDS: Final = 1.0
"""Between two looks for the end of another run [s]."""
SOON: Final = timedelta(minutes=1)
"""A run that is due later waits for its time, not for its turn."""
QUEUED: Final = ("SCHEDULED", "PENDING")
AT_WORK: Final = ("RUNNING", "CANCELLING")
ACTIVE: Final = (*QUEUED, *AT_WORK, "PAUSED")
ENDED: Final = ("COMPLETED", "FAILED", "CRASHED", "CANCELLED")


@dataclass(frozen=True)
class MatchRun:
    """A run of the deployment that processes matches.

    `state` is the type of its state, as `RUNNING`, and `link` its page in Prefect's dashboard. A
    run of a schedule is created long before it is due. `ended_at` is None until it ends.
    """

    id: str
    match_id: str
    state: str
    message: str
    link: str
    is_due: bool = True
    ended_at: datetime | None = None

    @property
    def is_ahead(self) -> bool:
        """Whether it takes a place of the worker before later runs."""
        return self.state != "PAUSED"


@dataclass(frozen=True)
class MatchRuns(PrefectApi):
    """Runs of matches of one served project.

    `pages` is the address of the review pages, to which runs link; empty if unknown.
    """

    name: str = "worldpose"
    pages: str = ""

    @classmethod
    def of_plan(cls, plan: ServePlan) -> MatchRuns:
        """Return the runs of a served project for one of its processes, which has the login."""
        login = os.environ.get(CLIENT_LOGIN)
        return cls(plan.prefect, login, name=plan.name, pages=plan.pages)

    def create_run(self, flow: str, **run: Any) -> dict[str, Any]:  # noqa: ANN401 - JSON
        """Create a run of a deployment from fields of Prefect's API; return Prefect's answer.

        A second call with the same `idempotency_key` returns the run of the first.

        Raises:
            UnreachablePrefectError: no run was created.
        """
        deployment = self.ask(f"/deployments/name/{quote(deployment_name(self.name, flow))}")
        created: dict[str, Any] = self.ask(f"/deployments/{deployment['id']}/create_flow_run", run)
        return created

    def start(
        self,
        match_id: str,
        *,
        priority: Priority = "normal",
        key: str | None = None,
        **parameters: JsonValue,
    ) -> MatchRun:
        """Create a run of a match; the worker starts it in its turn.

        A second call with the same key returns the run of the first. A parameter that is None has
        the default of the flow.

        Raises:
            UnreachablePrefectError: no run was created.
        """
        given = {name: value for name, value in parameters.items() if value is not None}
        created = self.create_run(
            "match",
            name=run_name(match_id),
            parameters={"match_id": match_id, **given},
            tags=[priority],
            work_queue_name=priority,
            # A request that is repeated after a lost answer creates no second run.
            idempotency_key=key or f"once-{uuid.uuid4()}",
        )
        return self._run(created)

    def active(self) -> list[MatchRun]:
        """Return all runs that have not ended, first to last, without those of a later time."""
        runs = self._list("expected_start_time", state=of_types(*ACTIVE))
        return [run for run in runs if run.is_due or run.state != "SCHEDULED"]

    def ended_runs(self, since: datetime) -> list[MatchRun]:
        """Return all runs that have ended since a time, first to last."""
        end = {"after_": since.isoformat()}
        return self._list("end_time", state=of_types(*ENDED), end_time=end)

    def progress(self, runs: Sequence[MatchRun]) -> dict[str, tuple[float, str]]:
        """Return percent and description of the progress of runs, by run id."""
        ids = [run.id for run in runs]
        wanted = {**of_types("progress"), "flow_run_id": {"any_": ids}}
        found = self.list_all("artifacts", artifacts=wanted) if ids else []
        return {
            each["flow_run_id"]: (float(each["data"]), each["description"] or "")
            for each in sorted(found, key=lambda each: parse_time(each["updated"]))
            if each["data"] is not None
        }

    def _list(self, order: str, **wanted: Mapping[str, Any]) -> list[MatchRun]:
        """Return all runs that match a filter, by one of their times."""
        runs = self.runs([deployment_name(self.name, "match").partition("/")[2]], **wanted)
        return [self._run(run) for run in sorted(runs, key=lambda run: parse_time(run[order]))]

    def _run(self, run: Mapping[str, Any]) -> MatchRun:
        due = run["next_scheduled_start_time"]
        return MatchRun(
            id=run["id"],
            match_id=str(run["parameters"].get("match_id")),
            state=str(run["state_type"]),
            message=str((run["state"] or {}).get("message") or ""),
            link=f"{self.api.removesuffix('/api')}/runs/flow-run/{run['id']}",
            is_due=not due or parse_time(due) <= datetime.now(UTC) + SOON,
            ended_at=parse_time(run["end_time"]) if run["end_time"] else None,
        )


def run_name(what: str, at: datetime | None = None) -> str:
    """Return the name of a run: what it processes, and its time, by default now."""
    return f"{what}, {(at or datetime.now()).astimezone():%d %b %H:%M:%S}"


def title_of(flow: str, parameters: Mapping[str, Any]) -> str:
    """Return what a run processes: its match, or the title of its flow."""
    return str(parameters.get("match_id") or TITLES.get(flow, flow))


def artifact_key(match_id: str) -> str:
    """Return the match's name in keys of Prefect's artifacts."""
    return re.sub(r"[^a-z0-9]+", "-", match_id.lower()).strip("-")


def match_runs_of(url: str) -> MatchRuns | None:
    """Return the runs of a project that a service on this machine serves now; None without one."""
    state = served_state(url)
    serving = state.read_serving()
    if serving is None or "serve" not in serving.services:
        return None
    if not is_alive(serving.services["serve"].pid):
        return None
    pages = serving.services.get("pages")
    address = "" if pages is None else pages.address or ""
    login = state.client_login(serving)
    return MatchRuns(serving.prefect, login, name=serving.name, pages=address)


@contextmanager
def alone_with(store: Store, match_id: str) -> Iterator[None]:
    """Wait until no other run of a deployment processes the match on this machine.

    The operating system ends the hold when the process ends.
    """
    state = served_state(store.url)
    with ExitStack() as stack:
        if state.folder.parent.is_dir():  # else this is a worker without a service's state
            lock = f"match-{match_id}"
            if not stack.enter_context(state.only_one(lock, wait=False)):
                LOG.info("%s: another run of it is at work; this one continues after it", match_id)
                stack.enter_context(state.only_one(lock, wait=True))
        while runs_at_work(store, match_id):  # by `worldpose run`, which takes no lock
            time.sleep(LOOK_SECONDS)
        yield
