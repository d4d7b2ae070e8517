"""Running a match: decide first, then start only what the decision needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pydantic import JsonValue

from data_contracts.run import RunRecord
from flows.planning import PlannedUnit, plan_run, selected_stages
from flows.prefect_environment import prefect_server
from flows.progress import reporter
from flows.run_record import RunLog, latest_run, standing_results
from flows.stage import Match
from worldpose.store import Store


@dataclass(frozen=True)
class RunRequest:
    """What a person asked for.

    Attributes:
        settings: stage to the settings that differ from their defaults.
        from_stage: first stage; earlier ones are taken from the latest run as they stand.
        until_stage: last stage.
        dask: address of a running Dask scheduler; None starts workers on this machine.
        workers: number of worker processes on this machine; None sizes it to the machine.
    """

    settings: dict[str, dict[str, JsonValue]]
    from_stage: str | None = None
    until_stage: str | None = None
    dask: str | None = None
    workers: int | None = None


def run_match(store: Store, match: Match, request: RunRequest) -> RunRecord:
    """The record of a run that makes the match's results current.

    When nothing is stale this is the latest run's own record, and neither Prefect nor Dask starts.

    Raises:
        UsageError: no such stage.
    """
    stages = selected_stages(request.from_stage, request.until_stage)
    standing = standing_results(store, match.match_id, request.from_stage)
    planned = plan_run(store, match, request.settings, stages, standing)
    if all(unit.published for unit in planned):
        return _without_work(store, match, request, planned, standing)
    reporter().say("starting Prefect and Dask")
    with prefect_server(store.url) as wait_until_ready:
        return _through_prefect(store, match, request, wait_until_ready)


def _without_work(
    store: Store,
    match: Match,
    request: RunRequest,
    planned: list[PlannedUnit],
    standing: dict[str, str],
) -> RunRecord:
    """The latest run's record where it has all these results, or else a new one."""
    results = standing | {unit.name: unit.key for unit in planned}
    latest = latest_run(store, match.match_id)
    is_current = latest is not None and latest.state == "complete"
    if is_current and results.items() <= latest.results.items():
        return latest.model_copy(update={"executed": (), "reused": tuple(sorted(results))})
    log = RunLog.begin(store, match, request.settings, request.from_stage)
    log.reuse(planned)
    return log.close()


def _through_prefect(
    store: Store, match: Match, request: RunRequest, wait_until_ready: Callable[[], None]
) -> RunRecord:
    from prefect.logging.handlers import APILogHandler
    from prefect_dask import DaskTaskRunner

    from flows.match import process_match

    if request.dask is not None:
        runner = DaskTaskRunner(address=request.dask)
    else:
        runner = DaskTaskRunner(
            cluster_kwargs={
                "n_workers": request.workers,
                "threads_per_worker": 1,
                "dashboard_address": "127.0.0.1:0",
                "silence_logs": "CRITICAL",
            }
        )
    wait_until_ready()
    try:
        record = process_match.with_options(task_runner=runner)(
            project=store.url,
            match_id=match.match_id,
            settings=request.settings,
            from_stage=request.from_stage,
            until_stage=request.until_stage,
        )
    finally:
        APILogHandler().flush()  # while the server is there to take the last lines
    return RunRecord.model_validate(record)
