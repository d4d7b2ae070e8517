"""The worker of a served project: it runs installed flows, and nothing that a server names."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from subprocess import PIPE
from typing import Any, Final

import anyio
import anyio.abc
import psutil
from anyio import to_thread
from prefect import Flow
from prefect.client.orchestration import PrefectClient
from prefect.client.schemas.objects import FlowRun, State, StateType
from prefect.exceptions import ParameterTypeError, SignatureMismatchError
from prefect.states import Cancelled, Crashed, Failed
from prefect.workers.base import BaseJobConfiguration, BaseVariables, BaseWorker, BaseWorkerResult

from data_contracts.operations import QueuedRun
from flows.service.run_queue import queue_of_parameters, queued_run
from worldpose.store.run_queue import RunQueue

LOG: Final = logging.getLogger("worldpose.operations")
CANCEL_SECONDS: Final = 2.0
"""Between two looks whether a run is to be cancelled [s]."""
END_SECONDS: Final = 15.0
"""Time for a cancelled run to end before it is killed [s]."""
JOB_TEMPLATE: Final[dict[str, Any]] = {
    "job_configuration": {"labels": {}},  # Prefect refuses an empty one
    "variables": {"type": "object", "properties": {}, "additionalProperties": False},
}
"""A run of our pools can choose neither command, environment nor folder."""


@dataclass(frozen=True)
class Installed:
    """A flow that the worker can run; a run must not change the fixed parameters."""

    flow: Flow[..., Any]
    fixed: Mapping[str, Any]


class RefusedRunError(Exception):
    """A run requests something that the worker does not allow."""


def require_installed(run: FlowRun, installed: Mapping[str, Installed]) -> Installed:
    """Return the installed flow of a run.

    RefusedRunError if the run belongs to another deployment, sets variables of its job, or has
    unknown or fixed parameters.
    """
    found = installed.get(str(run.deployment_id))
    if found is None:
        raise RefusedRunError("it is of no deployment that was installed with this service")
    if run.job_variables:
        raise RefusedRunError(f"a run may not choose {', '.join(sorted(run.job_variables))}")
    for name, value in found.fixed.items():
        if run.parameters.get(name) != value:
            raise RefusedRunError(f"parameter {name}: a run may not change it")
    try:
        found.flow.validate_parameters(run.parameters)
    except (ParameterTypeError, SignatureMismatchError, ValueError, TypeError) as error:
        raise RefusedRunError(f"parameters: {error}") from error
    return found


class _OwnJob(BaseJobConfiguration):
    """Job that takes nothing from the server: its templates could read the server's blocks."""

    @classmethod
    async def from_template_and_values(
        cls,
        base_job_template: dict[str, Any],
        values: dict[str, Any],
        client: PrefectClient | None = None,
    ) -> _OwnJob:
        return cls()


class ServedWorker(BaseWorker[_OwnJob, BaseVariables, BaseWorkerResult]):
    """Worker that runs installed flows in processes with this process's environment.

    It knows the installed flows by deployment id.
    """

    type = "worldpose"
    job_configuration = _OwnJob
    _description = "Runs the flows of a project that worldpose serves."

    def __init__(self, pool: str, installed: Mapping[str, Installed]) -> None:
        super().__init__(pool, name=f"{pool} on this machine")
        self.installed = installed

    async def run(
        self,
        flow_run: FlowRun,
        configuration: _OwnJob,
        task_status: anyio.abc.TaskStatus[int] | None = None,
    ) -> BaseWorkerResult:
        """Run an installed flow to its end; a refused run is set to failed, with the reason."""
        status = task_status or anyio.TASK_STATUS_IGNORED
        try:
            found = require_installed(flow_run, self.installed)
        except RefusedRunError as refusal:
            LOG.warning("run %r is refused: %s", flow_run.name, refusal)
            why = f"The worker refused this run: {refusal}"
            if (installed := self.installed.get(str(flow_run.deployment_id))) is not None:
                queue, run = await to_thread.run_sync(_take, flow_run, installed)
                await to_thread.run_sync(queue.change, run, "failed", why)
            refused: State[Any] = Failed(message=why)
            await self.client.set_flow_run_state(flow_run.id, refused, force=True)
            status.started(0)
            return BaseWorkerResult(identifier="refused", status_code=0)
        process = await anyio.open_process(
            [sys.executable, "-m", "flows.service.run_process", found.flow.name, str(flow_run.id)],
            env={**os.environ, **{name: it for name, it in configuration.env.items() if it}},
            stdin=PIPE,  # the run ends when this process does
            stdout=None,  # the worker's log
            stderr=None,
        )
        status.started(process.pid)
        queue, run = await to_thread.run_sync(_take, flow_run, found)
        await self._wait(process, flow_run, queue, run)
        # With another code Prefect would set a state, maybe after the run has restarted.
        return BaseWorkerResult(identifier=str(process.pid), status_code=0)

    async def _wait(
        self, process: anyio.abc.Process, flow_run: FlowRun, queue: RunQueue, first: QueuedRun
    ) -> None:
        """Wait for the end of a run's process; record an end that it did not record itself.

        A run that is cancelled is ended. One that was given up is left alone: its process can hang.
        """
        while True:
            with anyio.move_on_after(CANCEL_SECONDS):
                await process.wait()
            code, kind, why = process.returncode, None, "cancelled at Prefect"
            try:
                if there := (await self.client.read_flow_run(flow_run.id)).state:
                    kind, why = there.type, there.message or why
            except Exception as error:  # the server is gone, or the run was deleted: it goes on
                LOG.debug("run %r: %s", flow_run.name, error)
            run = await to_thread.run_sync(queue.latest, first)
            is_open = run.number == first.number or (run.state, run.pid) == ("begun", process.pid)
            # One that was cancelled before it was taken is retried, or ends itself.
            is_cancelled = run.state == "cancelled" and (code is not None or not is_open)
            if kind == StateType.CANCELLING or is_cancelled:
                if code is None:
                    await _end(process)
                with suppress(Exception):  # without a server, the queue alone knows it
                    cancelled: State[Any] = Cancelled(message=run.message if is_cancelled else why)
                    await self.client.set_flow_run_state(flow_run.id, cancelled, force=True)
                code, kind = 0, StateType.CANCELLED
            if code is not None and is_open:
                if kind == StateType.CANCELLED:
                    await to_thread.run_sync(queue.change, run, "cancelled", why)
                else:
                    why = f"its process ended with code {code}"
                    with suppress(Exception):  # without a server, the queue alone knows it
                        crashed: State[Any] = Crashed(message=why)
                        await self.client.set_flow_run_state(flow_run.id, crashed, force=True)
                    await to_thread.run_sync(queue.kill, run, why)
            if code is not None or (run.state == "failed" and run.stalled and not is_open):
                return


def _take(flow_run: FlowRun, installed: Installed) -> tuple[RunQueue, QueuedRun]:
    """Return the queue of an installed flow, and in it a run that Prefect gave to the worker."""
    queue = queue_of_parameters(installed.fixed)
    return queue, queue.take(queued_run(installed.flow.name, flow_run.model_dump(mode="json")))


async def _end(process: anyio.abc.Process) -> None:
    """End a run's process, and then the processes that it leaves."""
    with suppress(psutil.NoSuchProcess, ProcessLookupError):
        own = psutil.Process(process.pid)
        family = [own, *own.children(recursive=True)]
        process.terminate()
        with anyio.move_on_after(END_SECONDS):
            await process.wait()
        for each in filter(psutil.Process.is_running, family):
            each.kill()


async def work(pools: tuple[str, ...], installed: Mapping[str, Installed]) -> None:
    """Run due flow runs of work pools until this process ends.

    A run of a flow that is not installed fails.
    """
    async with anyio.create_task_group() as group:
        for pool in pools:
            group.start_soon(ServedWorker(pool, installed).start, False, False, lambda text: None)
