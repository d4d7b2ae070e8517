"""Deployments at the Prefect server, with their queues and limits."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Final
from uuid import UUID

from prefect import Flow
from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.actions import DeploymentUpdate, WorkPoolCreate, WorkPoolUpdate
from prefect.exceptions import ObjectNotFound
from prefect.schedules import Interval, Schedule

from flows.service.layout import PRIORITIES
from flows.service.plan import ServePlan
from flows.service.served_worker import JOB_TEMPLATE, Installed, ServedWorker
from worldpose.errors import InputError


def _of_project(plan: ServePlan) -> dict[str, Any]:
    return {"project": plan.project}


@dataclass(frozen=True)
class Deployed:
    """One deployed flow.

    Attributes:
        flow: its name at the server and in `module`.
        about: description.
        queue: default queue of its runs; None = in the pool of arrivals.
        parameters: parameters from the plan.
        schedule: schedule of its runs.
        module: module of the flow.
        fixed: parameters of the plan that a run must not change: the project that it processes, and
            the code that its workers run.
    """

    flow: str
    about: str
    queue: str | None
    parameters: Callable[[ServePlan], dict[str, Any]] = field(default=_of_project)
    schedule: Callable[[ServePlan], Schedule] | None = None
    module: str = "flows.service.deployed"
    fixed: tuple[str, ...] = ("project",)

    @property
    def entrypoint(self) -> str:
        """Module and name: importable wherever worldpose is installed."""
        return f"{self.module}.{self.flow}"


DEPLOYED: Final = (
    Deployed(
        "match",
        "Process a match; waits for people where a gate says so.",
        "normal",
        lambda plan: {
            "project": plan.project,
            "settings": {},
            "time_limits": plan.time_limits,
        },
    ),
    Deployed(
        "ingest",
        "Take in the matches that have arrived in the inbox.",
        None,
        lambda plan: {"plan": plan.model_dump(mode="json")},
        lambda plan: Interval(timedelta(minutes=plan.poll_minutes)),
        fixed=("plan",),
    ),
    Deployed(
        "reprocess",
        "Make every match current that an edit has touched.",
        "background",
        lambda plan: {
            "project": plan.project,
            "dask": plan.dask,
            "workers": plan.workers,
            "time_limits": plan.time_limits,
        },
        module="flows.reprocess",
        fixed=("project", "dask"),
    ),
    Deployed("release", "Freeze a match's complete run under a name, with a report.", None),
    Deployed("finetune", "Train the embedded nets on reviewed labels.", "background"),
)
"""Their names are also in `flows.service.plan.FLOWS`."""


def pools(plan: ServePlan) -> tuple[str, str]:
    """Return the names of the pool of matches and of the pool of arrivals."""
    return plan.name, f"{plan.name}-arrivals"


async def install(plan: ServePlan) -> dict[UUID, Installed]:
    """Create or update all deployments, pools and queues at the server.

    Returns:
        Flows that a worker can run, by deployment id.

    Raises:
        InputError: another project has deployments of this name at the server.
    """
    async with get_client() as client:
        await _refuse_other_project(client, plan)
        matches, arrivals = pools(plan)
        await _pool(client, matches, plan.max_concurrent, "Matches, urgent ones first")
        await _pool(client, arrivals, 1, "What arrives, while matches run")
        for rank, queue in enumerate(PRIORITIES, 1):
            await _queue(client, matches, queue, rank)
    return dict([await _deploy(plan, deployed) for deployed in DEPLOYED])


async def work(plan: ServePlan, installed: Mapping[UUID, Installed]) -> None:
    """Run due flow runs until this process ends.

    Args:
        plan: the served project.
        installed: flows that can run; a run of any other flow fails.
    """
    import anyio

    matches, arrivals = pools(plan)
    async with anyio.create_task_group() as group:
        for pool in (matches, arrivals):
            worker = ServedWorker(pool, installed)
            group.start_soon(worker.start, False, False, lambda text: None)


async def _deploy(plan: ServePlan, deployed: Deployed) -> tuple[UUID, Installed]:
    flow: Flow[..., Any] = getattr(importlib.import_module(deployed.module), deployed.flow)
    matches, arrivals = pools(plan)
    parameters = deployed.parameters(plan)
    deployment = await flow.ato_deployment(
        name=plan.name,
        description=deployed.about,
        parameters=parameters,
        schedule=None if deployed.schedule is None else deployed.schedule(plan),
        work_pool_name=arrivals if deployed.queue is None else matches,
        work_queue_name=deployed.queue,
        enforce_parameter_schema=False,  # the worker checks, with the flow that it runs
    )
    deployment.entrypoint = deployed.entrypoint
    number = await deployment.aapply()
    async with get_client() as client:  # applying the deployment again would not update these
        again = DeploymentUpdate(
            entrypoint=deployed.entrypoint, pull_steps=[], job_variables={}, path=None
        )
        await client.update_deployment(number, again)
    fixed = json.loads(json.dumps({name: parameters[name] for name in deployed.fixed}))
    return number, Installed(deployed.entrypoint, flow, fixed)


async def _refuse_other_project(client: PrefectClient, plan: ServePlan) -> None:
    try:
        there = await client.read_deployment_by_name(plan.match_deployment)
    except ObjectNotFound:
        return
    project = there.parameters.get("project")
    if project != plan.project:
        raise InputError(
            f"deployment {plan.match_deployment} at {plan.prefect}",
            expected=f"that of project {plan.project}",
            found=f"that of {project}",
            todo=(
                f"Was the project moved? Move it back, or remove {plan.state}: nothing is lost "
                "but Prefect's history, and what lies in the inbox is taken in once more."
                if plan.owns_prefect
                else "Give this project's deployments another name with --name."
            ),
        )


async def _pool(client: PrefectClient, name: str, limit: int, about: str) -> None:
    try:
        await client.read_work_pool(name)
    except ObjectNotFound:
        await client.create_work_pool(
            WorkPoolCreate(
                name=name,
                type=ServedWorker.type,
                base_job_template=JOB_TEMPLATE,
                concurrency_limit=limit,
                description=about,
            )
        )
    else:
        # Reset values that were changed there, or set by an earlier version.
        again = WorkPoolUpdate(concurrency_limit=limit, base_job_template=JOB_TEMPLATE)
        await client.update_work_pool(name, again)


async def _queue(client: PrefectClient, pool: str, name: str, rank: int) -> None:
    try:
        queue = await client.read_work_queue_by_name(name, pool)
    except ObjectNotFound:
        await client.create_work_queue(name, work_pool_name=pool, priority=rank)
    else:
        await client.update_work_queue(queue.id, priority=rank)
