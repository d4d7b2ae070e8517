"""Deployments at the Prefect server, with their queues and limits."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from prefect import Flow
from prefect.utilities.callables import parameter_schema

from flows.orchestration.prefect_api import PrefectApi
from flows.service.health import of_other_project
from flows.service.layout import PRIORITIES
from flows.service.match_runs import MatchRuns
from flows.service.plan import Schedule, ServePlan, deployment_name
from flows.service.recovery import adopt_due
from flows.service.worker import JOB_TEMPLATE, Installed, ServedWorker

MODULE: Final = "flows.service.deployed"
"""Module of the deployed flows; it starts Prefect's task runner when it is imported."""


@dataclass(frozen=True)
class Deployed:
    """One deployed flow.

    Attributes:
        flow: its name at the server and in `flows.service.deployed`.
        about: description.
        queue: default queue of its runs; None = that of the pool of arrivals.
        parameters: parameters from the plan.
        fixed: parameters of the plan that a run must not change: the project that it processes, and
            the code that its workers run.
        is_polled: whether it runs at the interval of the plan's `poll_minutes`.
    """

    flow: str
    about: str
    queue: str | None
    parameters: Callable[[ServePlan], dict[str, Any]] = lambda plan: {"project": plan.project}
    fixed: tuple[str, ...] = ("project",)
    is_polled: bool = False


DEPLOYED: Final = (
    Deployed(
        "match",
        "Process a match; waits for people where a gate says so.",
        "normal",
        lambda plan: {"project": plan.project, "time_limits": plan.time_limits},
    ),
    Deployed(
        "ingest",
        "Take in the matches that have arrived in the inbox.",
        None,
        lambda plan: {"plan": plan.model_dump(mode="json")},
        fixed=("plan",),
        is_polled=True,
    ),
    Deployed("reprocess", "Start a run of every match with results that an edit made stale.", None),
    Deployed("release", "Freeze a match's complete run under a name, with a report.", None),
    Deployed("finetune", "Train the embedded nets on reviewed labels.", "background"),
)
"""Their names are also in `flows.service.plan.FLOWS`."""
DEFAULT_QUEUE: Final = "default"
"""Queue that each of Prefect's pools has."""
SLUG: Final = "serve-schedule"
"""Slug of the schedule of `--schedule` at its deployment."""
POLL: Final = "poll-interval"
"""Slug of our schedule; all others are the operator's."""


def pools(plan: ServePlan) -> tuple[str, str]:
    """Return the names of the pool of matches and of the pool of arrivals."""
    return plan.name, f"{plan.name}-arrivals"


def install(plan: ServePlan) -> dict[str, Installed]:
    """Create what is absent of deployments, pools and queues, and update what differs.

    Schedules, tags, pauses, limits and planned runs of a deployment stay as an operator set them.
    Return flows that a worker can run, by deployment id; InputError if another project has
    deployments of this name at the server.
    """
    prefect = MatchRuns.of_plan(plan)
    if (refusal := of_other_project(prefect, plan, plan.state_folder)) is not None:
        raise refusal
    matches, arrivals = pools(plan)
    for pool, limit, about in (
        (matches, plan.max_concurrent, "Matches, urgent ones first"),
        (arrivals, 1, "What arrives, while matches run"),
    ):
        values = {"concurrency_limit": limit, "base_job_template": JOB_TEMPLATE}
        _install(prefect, "work_pools/", pool, values, type=ServedWorker.type, description=about)
    for rank, queue in enumerate(PRIORITIES, 1):
        _install(prefect, f"work_pools/{matches}/queues", queue, {"priority": rank})
    adopt_due(prefect)  # an update of a deployment removes its planned runs
    polled = prefect.deployment(deployment_name(plan.name, "ingest"))
    before = {} if polled is None else polled["parameters"].get("plan") or {}
    # The polled one last: it keeps the options that all others were installed with.
    order = sorted(DEPLOYED, key=lambda each: each.is_polled)
    return dict(_deploy(prefect, plan, deployed, before) for deployed in order)


def _deploy(
    prefect: PrefectApi, plan: ServePlan, deployed: Deployed, before: Mapping[str, Any]
) -> tuple[str, Installed]:
    flow: Flow[..., Any] = getattr(importlib.import_module(MODULE), deployed.flow)
    matches, arrivals = pools(plan)
    parameters = json.loads(json.dumps(deployed.parameters(plan)))
    wanted: dict[str, Any] = {
        "description": deployed.about,
        "entrypoint": f"{MODULE}.{deployed.flow}",
        "path": None,
        "pull_steps": [],
        "job_variables": {},
        "parameters": parameters,
        "parameter_openapi_schema": json.loads(parameter_schema(flow).model_dump_json()),
        "work_pool_name": arrivals if deployed.queue is None else matches,
        "work_queue_name": deployed.queue or DEFAULT_QUEUE,
        "enforce_parameter_schema": False,  # the worker checks, with the flow that it runs
    }
    name = deployment_name(plan.name, deployed.flow)
    there = prefect.deployment(name)
    if there is None:
        of_flow = prefect.ask("/flows/", {"name": flow.name})["id"]
        polling = [{"schedule": _polling(plan), "slug": POLL}] if deployed.is_polled else []
        new = {"name": name.partition("/")[2], "flow_id": of_flow, "schedules": polling}
        there = prefect.ask("/deployments/", {**new, **wanted})
        before = {}
    else:
        _update(prefect, plan, deployed, there, wanted)
    known = (before.get("schedules") or {}).get(deployed.flow)
    schedule = None if known is None else Schedule.model_validate(known)
    _set_schedule(prefect, there, plan.schedules.get(deployed.flow), schedule)
    fixed = {name: parameters[name] for name in deployed.fixed}
    return there["id"], Installed(flow, fixed)


def _set_schedule(
    prefect: PrefectApi,
    deployment: Mapping[str, Any],
    wanted: Schedule | None,
    before: Schedule | None,
) -> None:
    """Make or change the schedule of `--schedule` if the option differs from that `before`.

    Otherwise the schedule stays, also if the operator has changed, paused or removed it.
    """
    if wanted is None or wanted == before:
        return
    place, schedule = f"/deployments/{deployment['id']}/schedules", wanted.model_dump()
    there = [each["id"] for each in deployment["schedules"] if each["slug"] == SLUG]
    if there:
        prefect.ask(f"{place}/{there[0]}", {"schedule": schedule}, method="PATCH")
    else:
        prefect.ask(place, [{"schedule": schedule, "active": True, "slug": SLUG}])


def _polling(plan: ServePlan) -> dict[str, float]:
    return {"interval": 60.0 * plan.poll_minutes}


def _update(
    prefect: PrefectApi,
    plan: ServePlan,
    deployed: Deployed,
    there: Mapping[str, Any],
    wanted: Mapping[str, Any],
) -> None:
    """Update what the product decides of a deployment, if it differs.

    Each update makes Prefect remove the planned runs and plan them anew.
    """
    place = f"/deployments/{there['id']}"
    before = there["parameters"].get("plan") or {}
    if deployed.is_polled and before.get("poll_minutes") != plan.poll_minutes:
        # Otherwise the schedule stays, also if the operator has changed it or removed it.
        for schedule in there["schedules"]:
            if schedule["slug"] == POLL:
                changed = {"schedule": _polling(plan)}
                prefect.ask(f"{place}/schedules/{schedule['id']}", changed, method="PATCH")
    fields = wanted["parameter_openapi_schema"]["properties"]
    known = {name: it for name, it in there["parameters"].items() if name in fields}
    wanted = {**wanted, "parameters": {**known, **wanted["parameters"]}}
    if any(there[name] != value for name, value in wanted.items()):
        prefect.ask(place, wanted, method="PATCH")


def _install(prefect: PrefectApi, kind: str, name: str, values: dict[str, Any], **new: str) -> None:
    """Create a pool or a queue, or reset what was changed of it there."""
    place = f"/{kind.rstrip('/')}/{name}"
    if prefect.find(place) is None:
        prefect.ask(f"/{kind}", {"name": name, **new, **values})
    else:
        prefect.ask(place, values, method="PATCH")
