"""Deployments at the Prefect server, with their queues and limits."""

from __future__ import annotations

import importlib
import json
import logging
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Final
from uuid import UUID

import anyio
import anyio.abc
from prefect import Flow
from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.actions import (
    DeploymentScheduleCreate,
    DeploymentUpdate,
    WorkPoolCreate,
    WorkPoolUpdate,
)
from prefect.client.schemas.objects import FlowRun, State
from prefect.client.schemas.responses import DeploymentResponse
from prefect.client.schemas.schedules import IntervalSchedule
from prefect.exceptions import ObjectNotFound, ParameterTypeError, SignatureMismatchError
from prefect.runner._flow_run_executor import FlowRunExecutorContext
from prefect.runner._process_manager import ProcessHandle
from prefect.runner._starter_engine import EngineCommandStarter
from prefect.states import Failed
from prefect.utilities.callables import parameter_schema
from prefect.workers.process import (
    ProcessJobConfiguration,
    ProcessWorker,
    ProcessWorkerResult,
)

from flows.service.forms import form_schema, offer, offered_matches
from flows.service.layout import PRIORITIES
from flows.service.plan import ServePlan, deployment_name
from worldpose.errors import InputError

LOG: Final = logging.getLogger("worldpose.operations")
MODULE: Final = "flows.service.deployed"
"""Module of the deployed flows; it starts Prefect's task runner when it is imported."""


def _of_project(plan: ServePlan) -> dict[str, Any]:
    return {"project": plan.project}


@dataclass(frozen=True)
class Deployed:
    """One deployed flow.

    Attributes:
        flow: its name at the server and in `flows.service.deployed`.
        about: description.
        queue: default queue of its runs; None = that of the pool of arrivals.
        parameters: parameters from the plan.
        interval: option of the plan that is the interval of its runs [min]; None = no schedule.
        fixed: parameters of the plan that a run must not change: the project that it processes, and
            the code that its workers run.
    """

    flow: str
    about: str
    queue: str | None
    parameters: Callable[[ServePlan], dict[str, Any]] = field(default=_of_project)
    interval: str | None = None
    fixed: tuple[str, ...] = ("project",)

    @property
    def entrypoint(self) -> str:
        """Module and name: importable wherever worldpose is installed."""
        return f"{MODULE}.{self.flow}"


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
        interval="poll_minutes",
        fixed=("plan",),
    ),
    Deployed(
        "reprocess",
        "Start a run of every match with results that an edit made stale.",
        None,
    ),
    Deployed("release", "Freeze a match's complete run under a name, with a report.", None),
    Deployed("finetune", "Train the embedded nets on reviewed labels.", "background"),
)
"""Their names are also in `flows.service.plan.FLOWS`."""
DEFAULT_QUEUE: Final = "default"
"""Queue that each of Prefect's pools has."""
POLL: Final = "poll-interval"
"""Slug of the schedule of `Deployed.interval`; all others are the operator's."""


def pools(plan: ServePlan) -> tuple[str, str]:
    """Return the names of the pool of matches and of the pool of arrivals."""
    return plan.name, f"{plan.name}-arrivals"


async def install(plan: ServePlan) -> dict[UUID, Installed]:
    """Create what is absent of deployments, pools and queues, and update what differs.

    Schedules, tags, pauses, limits and planned runs of a deployment stay as an operator set them.

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
        return dict([await _deploy(client, plan, deployed) for deployed in DEPLOYED])


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


async def _deploy(
    client: PrefectClient, plan: ServePlan, deployed: Deployed
) -> tuple[UUID, Installed]:
    flow: Flow[..., Any] = getattr(importlib.import_module(MODULE), deployed.flow)
    matches, arrivals = pools(plan)
    parameters = json.loads(json.dumps(deployed.parameters(plan)))
    form = form_schema(parameter_schema(flow).model_dump(), deployed.fixed)
    wanted: dict[str, Any] = {
        "description": deployed.about,
        "entrypoint": deployed.entrypoint,
        "path": None,
        "pull_steps": [],
        "job_variables": {},
        "parameters": parameters,
        "parameter_openapi_schema": offer(form, ()),
        "work_pool_name": arrivals if deployed.queue is None else matches,
        "work_queue_name": deployed.queue or DEFAULT_QUEUE,
        "enforce_parameter_schema": False,  # the worker checks, with the flow that it runs
    }
    name = deployment_name(plan.name, deployed.flow)
    try:
        there = await client.read_deployment_by_name(name)
    except ObjectNotFound:
        schedules = []
        if deployed.interval is not None:
            polling = _every(plan, deployed.interval)
            schedules = [DeploymentScheduleCreate(schedule=polling, slug=POLL)]
        number = await client.create_deployment(
            await client.create_flow_from_name(flow.name),
            name.partition("/")[2],
            schedules=schedules,
            **wanted,
        )
    else:
        number = there.id
        await _update(client, plan, deployed, there, wanted)
    fixed = {name: parameters[name] for name in deployed.fixed}
    return number, Installed(deployed.entrypoint, flow, fixed)


def _every(plan: ServePlan, option: str) -> IntervalSchedule:
    return IntervalSchedule(interval=timedelta(minutes=getattr(plan, option)))


async def _update(
    client: PrefectClient,
    plan: ServePlan,
    deployed: Deployed,
    there: DeploymentResponse,
    wanted: Mapping[str, Any],
) -> None:
    """Update what the product decides of a deployment, if it differs.

    Each update makes Prefect remove the planned runs and plan them anew.
    """
    before = there.parameters.get("plan") or {}
    option = deployed.interval
    if option is not None and before.get(option) != getattr(plan, option):
        # Otherwise the schedule stays, also if the operator has changed it or removed it.
        for schedule in there.schedules:
            if schedule.slug == POLL:
                await client.update_deployment_schedule(
                    there.id, schedule.id, schedule=_every(plan, option)
                )
    form = wanted["parameter_openapi_schema"]
    known = {name: value for name, value in there.parameters.items() if name in form["properties"]}
    wanted = {
        **wanted,
        "parameters": {**known, **wanted["parameters"]},
        "parameter_openapi_schema": offer(form, offered_matches(there.parameter_openapi_schema)),
    }
    if any(getattr(there, name) != value for name, value in wanted.items()):
        await client.update_deployment(there.id, DeploymentUpdate(**wanted))


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
        # Reset values that were changed there.
        again = WorkPoolUpdate(concurrency_limit=limit, base_job_template=JOB_TEMPLATE)
        await client.update_work_pool(name, again)


async def _queue(client: PrefectClient, pool: str, name: str, rank: int) -> None:
    try:
        queue = await client.read_work_queue_by_name(name, pool)
    except ObjectNotFound:
        await client.create_work_queue(name, work_pool_name=pool, priority=rank)
    else:
        await client.update_work_queue(queue.id, priority=rank)


JOB_TEMPLATE: Final[dict[str, Any]] = {
    "job_configuration": {"stream_output": "{{ stream_output }}"},
    "variables": {
        "type": "object",
        "properties": {
            "stream_output": {
                "type": "boolean",
                "title": "Stream Output",
                "default": True,
                "description": "A run says what it does in the log of its worker.",
            }
        },
        "additionalProperties": False,
    },
}
"""A run of our pools can choose neither command, environment nor folder."""


@dataclass(frozen=True)
class Installed:
    """A flow that the worker can run.

    Attributes:
        entrypoint: module and name.
        flow: the flow.
        fixed: parameters that a run must not change.
    """

    entrypoint: str
    flow: Flow[..., Any]
    fixed: Mapping[str, Any]


class RefusedRunError(Exception):
    """A run requests something that the worker does not allow."""


def require_installed(run: FlowRun, installed: Mapping[UUID, Installed]) -> Installed:
    """Return the installed flow of a run.

    Args:
        run: run from the server.
        installed: flows by deployment id.

    Raises:
        RefusedRunError: the run belongs to another deployment, sets variables of its job, or has
            unknown or fixed parameters.
    """
    if run.deployment_id is None or run.deployment_id not in installed:
        raise RefusedRunError("it is of no deployment that was installed with this service")
    found = installed[run.deployment_id]
    chosen = sorted(set(run.job_variables or {}) - {"stream_output"})
    if chosen:
        raise RefusedRunError(f"a run may not choose {', '.join(chosen)}")
    for name, value in found.fixed.items():
        if run.parameters.get(name) != value:
            raise RefusedRunError(f"parameter {name}: a run may not change it")
    try:
        found.flow.validate_parameters(run.parameters)
    except (ParameterTypeError, SignatureMismatchError, ValueError, TypeError) as error:
        raise RefusedRunError(f"parameters: {error}") from error
    return found


class _OwnJob(ProcessJobConfiguration):
    """Job that takes nothing from the server: its templates could read the server's blocks."""

    @classmethod
    async def from_template_and_values(
        cls,
        base_job_template: dict[str, Any],
        values: dict[str, Any],
        client: PrefectClient | None = None,
    ) -> _OwnJob:
        return cls()


class _NoHooks:
    """Our flows have no hooks; to look for them, Prefect would load the deployment's code."""

    async def run_cancellation_hooks(self, flow_run: FlowRun, state: State[Any]) -> None:
        """Do nothing."""

    async def run_crashed_hooks(self, flow_run: FlowRun, state: State[Any]) -> None:
        """Do nothing."""


class ServedWorker(ProcessWorker):
    """Worker that runs installed flows in processes with this process's environment.

    Attributes:
        installed: flows by deployment id.
    """

    type = "process"
    job_configuration = _OwnJob

    def __init__(self, pool: str, installed: Mapping[UUID, Installed]) -> None:
        super().__init__(pool, name=f"{pool} on this machine", limit=None)
        self.installed = installed

    @classmethod
    def __dispatch_key__(cls) -> str:
        return "worldpose"  # "process" stays Prefect's own worker if requested by type

    async def run(
        self,
        flow_run: FlowRun,
        configuration: ProcessJobConfiguration,
        task_status: anyio.abc.TaskStatus[int] | None = None,
    ) -> ProcessWorkerResult:
        """Run an installed flow to its end; a refused run is set to failed, with the reason."""
        status = task_status or anyio.TASK_STATUS_IGNORED
        try:
            found = require_installed(flow_run, self.installed)
        except RefusedRunError as refusal:
            LOG.warning("run %r is refused: %s", flow_run.name, refusal)
            refused: State[Any] = Failed(message=f"The worker refused this run: {refusal}")
            await self.client.set_flow_run_state(flow_run.id, refused, force=True)
            status.started(0)
            return ProcessWorkerResult(identifier="refused", status_code=0)
        with tempfile.TemporaryDirectory(suffix="prefect") as folder:
            async with FlowRunExecutorContext() as context:
                starter = EngineCommandStarter(
                    entrypoint=found.entrypoint,
                    cwd=folder,
                    stream_output=configuration.stream_output,
                    control_channel=context.control_channel,
                )
                executor = context.create_executor(
                    flow_run, starter, hook_runner=_NoHooks(), propose_submitting=False
                )
                code: list[int | None] = []

                async def execute(
                    *,
                    task_status: anyio.abc.TaskStatus[ProcessHandle] = anyio.TASK_STATUS_IGNORED,
                ) -> None:
                    done = await executor.submit(task_status=task_status)
                    code.append(None if done is None else done.status_code)

                async with anyio.create_task_group() as group:
                    handle = await group.start(execute)
                    if handle.pid is None:
                        raise RuntimeError("the process of a run has no id")
                    status.started(handle.pid)
        if not code or code[0] is None:
            raise RuntimeError("the process of a run did not start")
        return ProcessWorkerResult(identifier=str(handle.pid), status_code=code[0])
