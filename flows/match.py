"""The flow of one match: every stage of the method, fanned out over Dask.

The flow decides what must run, hands each missing unit to its task, and records the run. It holds
no state that matters: killed anywhere, the next run finds in the store what was finished.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator
from typing import Any

from prefect import Task, flow
from prefect.futures import as_completed
from pydantic import JsonValue

from flows.planning import PlannedUnit, plan_stage
from flows.progress import reporter
from flows.registering import open_match
from flows.run_record import RunLog
from flows.settings import selected_stages
from flows.stage import Match, Stage
from worldpose.errors import WorldposeError
from worldpose.store import Store


class IncompleteRunError(WorldposeError):
    """A run is recorded, but some of its units have no result."""

    def __init__(self, match_id: str, run_id: str, failed: int) -> None:
        self.match_id, self.run_id = match_id, run_id
        super().__init__(f"run {run_id} of {match_id}: {failed} units failed")


@flow(name="match", flow_run_name="{match_id}", validate_parameters=False)
def process_match(
    project: str,
    match_id: str,
    settings: dict[str, dict[str, JsonValue]],
    from_stage: str | None = None,
    until_stage: str | None = None,
) -> str:
    """Runs the method on one match, records the run and returns its number.

    Args:
        project: folder or URL of the store.
        match_id: a registered match.
        settings: stage to the settings that differ from their defaults.
        from_stage: first stage to run; earlier ones are taken from the latest run as they stand.
        until_stage: last stage to run.

    Raises:
        IncompleteRunError: some units failed; the others have their results.
    """
    logging.getLogger("worldpose").setLevel(logging.INFO)
    store = Store.open(project)
    match = open_match(store, match_id)
    log = RunLog.begin(store, match, selected_stages(from_stage, until_stage), settings)
    for stage in log.stages:
        plan = plan_stage(store, match, stage, settings, log.results)
        missing = [unit for unit in plan.units if not unit.published]
        log.blocked += plan.blocked
        log.reuse(unit for unit in plan.units if unit.published)
        reporter().stage_started(
            stage.name, stage.about, units=len(plan.units), missing=len(missing)
        )
        for unit, failure in _compute(store, match, stage, missing, log.run_id):
            log.finished(unit, failure)
    record = log.close()
    if record.failed:
        raise IncompleteRunError(match_id, record.run_id, len(record.failed))
    return record.run_id


def _compute(
    store: Store, match: Match, stage: Stage, units: list[PlannedUnit], run_id: str
) -> Iterator[tuple[PlannedUnit, BaseException | None]]:
    """Each unit as its task ends, with what it failed of."""
    task = task_of(stage)
    submitted = {task.submit(unit.work(store.url, match, run_id)): unit for unit in units}
    for future in as_completed(list(submitted)):
        try:
            future.result()
        except Exception as failure:  # recorded with the run: siblings go on
            yield submitted[future], failure
        else:
            yield submitted[future], None


def task_of(stage: Stage) -> Task[..., Any]:
    """The task that computes one unit of a stage: the function of its name in `tasks`."""
    task: Task[..., Any] = getattr(importlib.import_module(f"tasks.{stage.name}"), stage.name)
    return task
