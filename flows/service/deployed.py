"""Flows as deployed: with Dask workers, and with plain JSON parameters."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, cast

from prefect import flow
from prefect.artifacts import create_markdown_artifact, create_table_artifact
from prefect.client.schemas.objects import FlowRun
from prefect.deployments import run_deployment
from prefect.task_runners import TaskRunner
from prefect_dask import DaskTaskRunner
from pydantic import JsonValue, TypeAdapter, ValidationError

from data_contracts.finetune import NetKind
from data_contracts.operations import Arrival
from data_contracts.records import Name
from flows.match import process_match
from flows.orchestration.prefect_environment import served_cluster
from flows.registering import open_match
from flows.reprocess import reprocess_matches
from flows.running import RunRequest
from flows.service.inbox import take_in
from flows.service.plan import ServePlan
from flows.stage import Match
from worldpose.errors import UsageError, WorldposeError
from worldpose.store import Store, open_run

NAME: Final = TypeAdapter(Name)
LOG = logging.getLogger("worldpose.operations")

RUNNER: Final = cast("TaskRunner[Any]", DaskTaskRunner(**served_cluster()))

match = process_match.with_options(task_runner=RUNNER)
"""Flow that processes one match; suspended while its results need review."""


@flow(name="ingest", flow_run_name="inbox", validate_parameters=False)
def ingest(plan: dict[str, Any]) -> list[str]:
    """Register every complete arrival, and start a run for each; return their ids.

    Args:
        plan: a `ServePlan` as JSON.
    """
    LOG.setLevel(logging.INFO)
    served = ServePlan.model_validate(plan)

    def begin(opened: Match, arrival: Arrival) -> str:
        return _begin(served, opened, arrival)

    decided = take_in(
        Store.create(served.project),
        served.state_folder,
        served.inbox,
        served.settle_seconds,
        begin,
    )
    for arrival in decided:
        LOG.info("%s: %s %s", arrival.name, arrival.state, arrival.reason)
    if decided:
        create_table_artifact(
            key="arrivals",
            table=[
                {
                    "arrival": each.name,
                    "state": each.state,
                    "match": each.match_id or "",
                    "why": each.reason,
                }
                for each in decided
            ],
            description=f"What arrived in {served.inbox}",
        )
    return [arrival.match_id for arrival in decided if arrival.match_id]


def _begin(plan: ServePlan, opened: Match, arrival: Arrival) -> str:
    begun = run_deployment(
        plan.match_deployment,
        parameters={"match_id": opened.match_id},
        flow_run_name=opened.match_id,
        timeout=0,
        as_subflow=False,
        tags=[arrival.priority],
        # After a kill, or for a moved folder, a second call returns the existing run.
        idempotency_key=f"arrival-{opened.registration.identity}",
        work_queue_name=arrival.priority,
    )
    return str(cast("FlowRun", begun).id)  # already awaited, outside an event loop


class UnprocessedError(WorldposeError):
    """Some matches could not be recomputed; the others are current."""


@flow(name="reprocess", validate_parameters=False)
def reprocess(
    project: str,
    matches: tuple[str, ...] | list[str] = (),
    settings: dict[str, dict[str, JsonValue]] | None = None,
    retry: bool = False,
    dask: str | None = None,
    workers: int | None = None,
    time_limits: dict[str, float] | None = None,
) -> dict[str, str]:
    """Recompute the stale results of every match of a project; return each match's state.

    Nothing is started if nothing is stale. A match that waits for review is no failure; its run
    continues when this flow is called again after the verdict.

    Args:
        project: folder or URL of the store.
        matches: ids of registered matches; none = all.
        settings: stage to settings that override those of each match's latest run.
        retry: retry failed units, even without an edit.
        dask: address of a running Dask scheduler; None starts workers on this machine.
        workers: number of worker processes on this machine; None = one per core.
        time_limits: stage to the time limit of a unit [min], if not the default.

    Raises:
        UnprocessedError: some matches failed or are partial; the others are done.
    """
    request = RunRequest(settings or {}, dask=dask, workers=workers, time_limits=time_limits or {})
    found = reprocess_matches(Store.open(project), tuple(matches), request, retry=retry)
    unprocessed = [
        f"{each.match_id} is {each.state}" + (f": {each.problem}" if each.problem else "")
        for each in found
        if each.state in ("failed", "partial")
    ]
    if unprocessed:
        raise UnprocessedError("; ".join(unprocessed))
    return {each.match_id: each.state for each in found}


@flow(name="release", flow_run_name="release {name} of {match_id}", validate_parameters=False)
def release(
    project: str,
    match_id: str,
    name: str,
    licence: str,
    formats: Sequence[str] = ("worldpose",),
    out: str | None = None,
) -> str:
    """Release the latest run of a match under a name, with a report; return the folder.

    Args:
        project: folder or URL of the store.
        match_id: a match whose latest run is complete.
        name: name of the release.
        licence: text of the data licence.
        formats: export formats.
        out: output folder; `releases/<match>/<name>` of the project if None.

    Raises:
        WorldposeError: the latest run is not complete.
    """
    from flows.reports.report import write_report
    from flows.results.best_results import Origin  # imported here, as everything that few runs need
    from flows.results.export import release as write_release

    store = Store.open(project)
    opened = open_match(store, match_id)
    run = open_run(project, opened.match_id, complete=True)
    if run.record.state != "complete":
        raise WorldposeError(
            f"run {run.record.run_id} of {match_id}: expected a complete one, found "
            f"{run.record.state}. Run the match to the end and decide the pending reviews first."
        )
    folder = release_folder(store, opened.match_id, name, out)
    origin = Origin(run, opened.registration, None)
    write_release(store, origin, list(formats), folder, name, licence)
    report = folder.with_name(f"{folder.name}-report.html")
    write_report(store, opened, report, run_id=run.record.run_id, videos=False)
    create_markdown_artifact(
        f"Run {run.record.run_id} of {match_id}\n\n- files: `{folder}`\n- report: `{report}`",
        key="release",
        description=f"Release {name} of {match_id}",
    )
    return str(folder)


def release_folder(store: Store, match_id: str, name: str, out: str | None) -> Path:
    """Return the output folder of a release.

    Raises:
        UsageError: the name is not valid for a folder, or the project is not in a local folder.
    """
    if out is not None:
        return Path(out)
    try:
        NAME.validate_python(name)
    except ValidationError:
        raise UsageError(
            f"release {name!r}",
            expected="a name of letters, digits, `.`, `_` and `-`",
            found=repr(name),
            todo="Choose a name of these characters.",
        ) from None
    if "://" in store.url:
        raise UsageError(
            f"release {name} of {match_id}",
            expected="`out`, a folder on this machine: the project is in object storage",
            found="none",
            todo="Name one.",
        )
    return Path(store.url) / "releases" / match_id / name


@flow(name="finetune", validate_parameters=False)
def finetune(
    project: str,
    annotations: str,
    pictures: str | None = None,
    nets: Sequence[NetKind] = ("people", "keypoints"),
    settings: dict[str, Any] | None = None,
    starts: dict[NetKind, str] | None = None,
) -> list[str]:
    """Train the embedded nets on reviewed labels; return the files of their new versions.

    Args:
        project: folder of the store, which holds the versions.
        annotations: file with COCO keypoints.
        pictures: the folder of their images; that of the annotations if None.
        nets: nets to train.
        settings: training settings that differ from their defaults.
        starts: net to its initial weights, if not the shipped ones.
    """
    from flows.finetune import FOLDER, fine_tune_nets  # torch takes seconds to import
    from worldpose.training import FineTuningSettings

    versions = fine_tune_nets.fn(  # in this flow, not as a subflow
        Path(annotations),
        None if pictures is None else Path(pictures),
        Path(project) / FOLDER,
        nets,
        FineTuningSettings.model_validate(settings or {}),
        {kind: Path(file) for kind, file in (starts or {}).items()},
    )
    return [version.file for version in versions]
