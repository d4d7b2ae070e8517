"""Execution of a stage's units as Prefect tasks on Dask workers."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final

import dask
from distributed import Client
from prefect import Task
from prefect.context import FlowRunContext
from prefect.futures import as_completed

from data_contracts.work import Work
from flows.orchestration.cluster_errors import require_workers
from flows.planning import PlannedUnit
from flows.stage import Stage

MOST_TASKS: Final = 200
"""Tasks per stage; more units share tasks. Prefect needs 0.1 s of CPU time per task."""
TASKS_EACH: Final = 20
"""Tasks per worker if units share tasks, so that no worker waits long for the last task [1]."""


def compute(
    stage: Stage, units: list[PlannedUnit], work: list[Work]
) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
    """Yield each unit when its task ends, with its exception if it failed.

    Raises:
        LostWorkersError: the Prefect server or Dask scheduler is gone.
    """
    with _placed(stage) if units else nullcontext():
        if len(units) <= MOST_TASKS:
            yield from _each_alone(stage, units, work)
        else:
            yield from _in_batches(units, work, task_count(len(_workers(_client()))))


def task_count(workers: int) -> int:
    """Return the number of tasks for a stage with more than MOST_TASKS units."""
    return min(max(1, workers) * TASKS_EACH, MOST_TASKS)


def _each_alone(
    stage: Stage, units: list[PlannedUnit], work: list[Work]
) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
    task = task_of(stage)
    submitted = {task.submit(each): unit for unit, each in zip(units, work, strict=True)}
    for future in as_completed(list(submitted)):
        try:
            future.result()
        except Exception as failure:  # recorded with the run; other units continue
            require_workers(failure)
            yield submitted[future], failure
        else:
            yield submitted[future], None


def _in_batches(
    units: list[PlannedUnit], work: list[Work], count: int
) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
    from tasks.batch import batch  # imported here, as all tasks are

    size = math.ceil(len(units) / count)
    submitted = {}
    for first in range(0, len(units), size):
        some = units[first : first + size]
        name = f"{some[0].name} and {len(some) - 1} more"
        texts = [each.model_dump_json() for each in work[first : first + size]]
        submitted[batch.submit(name, texts)] = some
    for future in as_completed(list(submitted)):
        some = submitted[future]
        failures: list[Exception | None]
        try:
            failures = future.result()
        except Exception as failure:
            failures = [failure] * len(some)
        for unit, each in zip(some, failures, strict=True):
            if each is not None:
                require_workers(each)
            yield unit, each


def task_of(stage: Stage) -> Task[..., Any]:
    """Return the task that computes one unit of a stage: the function of its name in `tasks`."""
    task: Task[..., Any] = getattr(importlib.import_module(f"tasks.{stage.name}"), stage.name)
    return task


def _placed(stage: Stage) -> AbstractContextManager[Any]:
    client = _client()
    return nullcontext() if client is None else on_workers_with(stage.worker_tag, client)


def _client() -> Client | None:
    """Return the flow's client of its Dask scheduler; None if its tasks use no scheduler."""
    context = FlowRunContext.get()
    return getattr(context and context.task_runner, "client", None)


def _workers(client: Client | None) -> dict[str, Any]:
    """Return the current workers, by address."""
    return {} if client is None else dict(client.scheduler_info(n_workers=-1)["workers"])


def on_workers_with(tag: str | None, client: Client) -> AbstractContextManager[Any]:
    """Return a context that sends tasks to workers with a tag, if any: `--resources TAG=1`."""
    if tag and any(worker["resources"].get(tag) for worker in _workers(client).values()):
        block: AbstractContextManager[Any] = dask.annotate(resources={tag: 1})
        return block
    return nullcontext()
