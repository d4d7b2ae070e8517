"""Flow of one match: every stage of the method, fanned out over Dask.

The flow plans the units, submits each missing one as a task, and records the run. It holds no
essential state: after a kill, the next run finds the finished results in the store.
"""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager, nullcontext

from prefect import flow
from pydantic import JsonValue

from data_contracts.run import GatePolicy, RunRecord
from flows.basis import basis_of
from flows.fan_out import compute
from flows.gatekeeping import Gatekeeper, undecided
from flows.orchestration.suspension import is_deployed, take_verdict
from flows.orchestration.time_limits import TimeLimits, seconds_of
from flows.outlook import look_ahead
from flows.progress import reporter
from flows.registering import open_match
from flows.run_record import RunLog, latest_run
from flows.settings import Overrides, selected_stages
from flows.stage import Match, Stage
from worldpose.errors import WorldposeError
from worldpose.store import Store


class IncompleteRunError(WorldposeError):
    """A run is recorded, but some of its units have no result, or need review."""

    def __init__(self, record: RunRecord) -> None:
        self.run_id = record.run_id
        super().__init__(
            f"run {record.run_id} of {record.match_id}: {len(record.failed)} units failed, "
            f"{len(record.waiting)} wait for review, {len(record.blocked)} are blocked"
        )


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

    A deployment's run that needs review is suspended until people have decided, and then resumes;
    any other run ends, and the next one continues.

    Args:
        project: folder or URL of the store.
        match_id: a registered match.
        settings: stage to its settings that differ from their defaults.
        from_stage: first stage to run; earlier results are taken from the latest run.
        until_stage: last stage to run.
        gates: when results need review; None is `auto` for a deployment, else `never`.
        iteration: iteration number; the previous iterations have their results.
        time_limits: stage to the time limit of a unit [min], if not the default.

    Raises:
        IncompleteRunError: some units failed or need review; the others have their results.
        LostWorkersError: the Prefect server or Dask scheduler is gone; another run resumes.
    """
    logging.getLogger("worldpose").setLevel(logging.INFO)
    store = Store.open(project)
    stages = selected_stages(from_stage, until_stage)
    policy: GatePolicy = gates or ("auto" if is_deployed() else "never")
    while True:
        match = open_match(store, match_id)
        if is_deployed():
            latest = latest_run(store, match_id)
            outlook = look_ahead(
                Gatekeeper(store, match, policy),
                settings,
                stages,
                basis_of(store, match, stages, settings, latest, iteration),
            )
            open_questions = undecided(outlook.waiting)
            if open_questions and outlook.is_recorded_by(latest):
                take_verdict(store, match_id, open_questions)
                continue
        with _shown(store, match_id) if is_deployed() else nullcontext():
            record = _run_stages(
                store, match, stages, settings, policy, iteration, time_limits or {}
            )
        if record.failed or not (is_deployed() and undecided(record.waiting)):
            break
    if record.state != "complete":
        raise IncompleteRunError(record)
    return record.run_id


def _shown(store: Store, match_id: str) -> AbstractContextManager[None]:
    from flows.service.artifacts import shown_at_prefect  # only deployments use it

    return shown_at_prefect(store, match_id)


def _run_stages(
    store: Store,
    match: Match,
    stages: tuple[Stage, ...],
    settings: Overrides,
    policy: GatePolicy,
    iteration: int,
    time_limits: TimeLimits,
) -> RunRecord:
    log = RunLog.begin(store, match, stages, settings, policy, iteration)
    for stage in stages:
        plan = log.plan(stage)
        missing = [unit for unit in plan.units if not unit.published]
        log.blocked += plan.blocked
        log.reuse(unit for unit in plan.units if unit.published)
        reporter().stage_started(
            stage.name, stage.about, units=len(plan.units), missing=len(missing)
        )
        work = [
            unit.work(store.url, match, log.run_id, seconds_of(stage.name, time_limits))
            for unit in missing
        ]
        for unit, failure in compute(stage, missing, work):
            log.finished(unit, failure)
        log.hold(stage)
    return log.close()
