"""Flow of one match: every stage of the method, fanned out over Dask.

The flow plans the units, submits each missing one as a task, and records the run. It holds no
essential state: after a kill, the next run finds the finished results in the store.
"""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final

import dask
from distributed import Client
from prefect import Task, flow
from prefect.context import FlowRunContext, SettingsContext, get_settings_context
from prefect.futures import as_completed
from pydantic import JsonValue

from data_contracts.run import GatePolicy, RunRecord
from data_contracts.work import Work
from flows.orchestration.local_cluster import require_workers, short_seconds
from flows.overview import make_summary
from flows.progress import reporter
from flows.registering import open_match
from flows.run_plan import PlannedUnit
from flows.run_record import RunLog, describe_end
from flows.settings import TimeLimits, seconds_of, selected_stages
from flows.stage import Stage
from worldpose.errors import WorldposeError
from worldpose.store.store import Store

WITHOUT_CAMERAS: Final = ("ingest", "detection")
"""Last stages of runs that need no calibrated camera."""
MOST_TASKS: Final = 200
"""Tasks per stage; more units share tasks. Prefect needs 0.05 s of CPU time per task."""
TASKS_EACH: Final = 20
"""Tasks per worker if many units share tasks, so that no worker waits long for the last one [1]."""
TASK_SECONDS: Final = 6.0
"""Processor time of a task whose units would take less than a second each [s]."""


class SharedSettings(SettingsContext):
    """Prefect's settings, which each task gets as they are.

    Prefect would write them as JSON for each task and parse and check all 300 again in its worker,
    which takes 0.05 s of CPU time.
    """

    @classmethod
    def current(cls) -> SharedSettings:
        """Return the settings in force."""
        given = get_settings_context()
        return cls(profile=given.profile, settings=given.settings)

    def serialize(self, include_secrets: bool = True) -> dict[str, Any]:
        """Return what a task's own context is made of."""
        return {"profile": self.profile, "settings": self.settings}


class IncompleteRunError(WorldposeError):
    """A run is recorded, but some of its units have no result, or need review."""

    def __init__(self, record: RunRecord) -> None:
        self.run_id = record.run_id
        super().__init__(describe_end(record))


@flow(name="match", flow_run_name="{match_id}", validate_parameters=False)
def process_match(
    project: str,
    match_id: str,
    settings: dict[str, dict[str, JsonValue]],
    from_stage: str | None = None,
    until_stage: str | None = None,
    gates: GatePolicy | None = None,
    iteration: int = 1,
    time_limits: dict[str, float] | None = None,
) -> str:
    """Run the method on one match, record the run and return its number.

    The settings by stage are those that differ from their defaults, and the time limits of a unit
    by stage [min], too. The latest run supplies the results before `from_stage`, and the iterations
    before this one have theirs. Without `gates`, no result needs review. IncompleteRunError if some
    units failed or need review; LostWorkersError if the Prefect server or Dask scheduler is gone:
    another run resumes.
    """
    logging.getLogger("worldpose").setLevel(logging.INFO)
    store = Store.open(project)
    stages = selected_stages(from_stage, until_stage)
    # 2D poses can locate cameras that nothing else tells.
    match = open_match(store, match_id, unfinished=until_stage in WITHOUT_CAMERAS)
    log = RunLog.begin(store, match, stages, settings, gates or "never", iteration)
    return require_complete(run_stages(log, time_limits or {}))


def require_complete(record: RunRecord) -> str:
    """Return the number of a complete run."""
    if record.state != "complete":
        raise IncompleteRunError(record)
    return record.run_id


def run_stages(log: RunLog, time_limits: TimeLimits) -> RunRecord:
    """Compute the missing units of a run on the Dask workers of this flow; return its record."""

    def compute_missing(
        stage: Stage, units: list[PlannedUnit]
    ) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
        if stage.needs_static_cameras and not log.match.has_static_cameras:
            reporter().say(f"{stage.name}: no units, as the match has no static cameras")
            return
        missing = [unit for unit in units if not unit.published]
        if units:  # a stage without units in this match, or held by a question, is no news
            reporter().stage_started(
                stage.name, stage.about, units=len(units), missing=len(missing)
            )
        seconds = seconds_of(stage.name, time_limits)
        work = [unit.work(log.store.url, log.match, log.run_id, seconds) for unit in missing]
        yield from compute(stage, missing, work)

    with SharedSettings.current():
        record = log.run_stages(compute_missing)
    make_summary(log.store, record.match_id)
    return record


def compute(
    stage: Stage, units: list[PlannedUnit], work: list[Work]
) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
    """Yield each unit when its task ends, with its exception if it failed.

    LostWorkersError if the Prefect server or Dask scheduler is gone.
    """
    client = _client()
    with nullcontext() if client is None else on_workers_with(stage.worker_tag, client):
        tasks = task_count([short_seconds(unit) for unit in units], len(_workers(client)))
        if tasks < len(units):
            yield from _in_batches(stage, units, work, tasks)
        else:
            yield from _each_alone(stage, units, work)


def task_count(seconds: list[float], workers: int) -> int:
    """Return the number of tasks of a stage.

    The processor time of a unit is infinite unless it is short [s].
    """
    units, workers = len(seconds), max(1, workers)
    if sum(seconds) < math.inf:
        few = max(workers, math.ceil(sum(seconds) / TASK_SECONDS))
        return min(units, few, MOST_TASKS)
    return units if units <= MOST_TASKS else min(workers * TASKS_EACH, MOST_TASKS)


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
    stage: Stage, units: list[PlannedUnit], work: list[Work], count: int
) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
    """Compute units in tasks of several; the units of a task that failed as a whole, alone."""
    from tasks.batch import batch  # imported here, as all tasks are

    size = math.ceil(len(units) / count)
    submitted = {}
    for first in range(0, len(units), size):
        some, theirs = units[first : first + size], work[first : first + size]
        name = f"{some[0].name} and {len(some) - 1} more"
        asked = batch.submit(name, stage.task_module, [each.model_dump_json() for each in theirs])
        submitted[asked] = some, theirs
    for future in as_completed(list(submitted)):
        some, theirs = submitted[future]
        failures: list[Exception | None]
        try:
            failures = future.result()
        except Exception as failure:
            require_workers(failure)
            yield from _each_alone(stage, some, theirs)
            continue
        for unit, each in zip(some, failures, strict=True):
            if each is not None:
                require_workers(each)
            yield unit, each


def task_of(stage: Stage) -> Task[..., Any]:
    """Return the task that computes one unit of a stage: the function of its name."""
    task: Task[..., Any] = getattr(importlib.import_module(stage.task_module), stage.name)
    return task


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
