"""Worker of a served project: it runs the installed flows, and nothing else.

A client of Prefect's API can create deployments that fetch code, and give runs a command, an
environment or a folder. This worker takes only a run's id and parameters from the server: command,
code and environment are its own.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final
from uuid import UUID

import anyio
import anyio.abc
from prefect import Flow
from prefect.client.orchestration import PrefectClient
from prefect.client.schemas.objects import FlowRun, State
from prefect.exceptions import ParameterTypeError, SignatureMismatchError
from prefect.runner._flow_run_executor import FlowRunExecutorContext
from prefect.runner._process_manager import ProcessHandle
from prefect.runner._starter_engine import EngineCommandStarter
from prefect.states import Failed
from prefect.workers.process import (
    ProcessJobConfiguration,
    ProcessWorker,
    ProcessWorkerResult,
)

LOG = logging.getLogger("worldpose.operations")

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
        RefusedRunError: it belongs to another deployment, sets variables of its job, or has unknown
            or fixed parameters.
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
