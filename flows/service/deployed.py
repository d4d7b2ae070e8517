"""Flows as deployed: with Dask workers, and with plain JSON parameters."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast
from urllib.parse import quote

from prefect import flow
from prefect.artifacts import create_link_artifact
from prefect.context import FlowRunContext
from prefect.runtime import flow_run
from prefect.task_runners import TaskRunner
from prefect_dask import DaskTaskRunner
from pydantic import JsonValue, TypeAdapter, ValidationError

from data_contracts.finetune import NetKind
from data_contracts.operations import Arrival
from data_contracts.records import Name
from data_contracts.run import GatePolicy, RunRecord
from data_contracts.settings import IterationCount
from flows.gates import Gatekeeper, waiting_for_verdicts
from flows.iterate import iterate_match
from flows.match import require_complete, run_stages
from flows.orchestration.prefect_environment import served_cluster
from flows.orchestration.suspension import take_verdict
from flows.progress import Reporter, reporter, reporting_to
from flows.registering import open_match
from flows.reprocess import reprocess_matches
from flows.results.automatic_exports import export_after_run
from flows.run_plan import plan_ahead
from flows.run_record import RunLog, alone_with, expected_work, latest_run
from flows.running import RunRequest, settle
from flows.service.inbox import run_key, take_in
from flows.service.match_runs import MatchRuns, match_runs_of, run_name, title_of
from flows.service.plan import ServePlan
from flows.settings import selected_stages
from flows.stage import Match
from tasks.tracing import start_tracing
from worldpose.errors import UsageError, WorldposeError
from worldpose.store.store import Store, open_run

NAME: Final = TypeAdapter(Name)
LOG = logging.getLogger("worldpose.operations")

start_tracing()  # before the flow of this process starts, so that its span is exported
RUNNER: Final = cast("TaskRunner[Any]", DaskTaskRunner(**served_cluster()))


def _name_run() -> str:
    """Return the name that the run was created with, or one of the same form."""
    what = title_of(str(flow_run.flow_name), flow_run.parameters)
    name = str(flow_run.name or "")
    return name if name.startswith(f"{what}, ") else run_name(what)


def link_pages(pages: str, match_id: str) -> None:
    """Link this flow run to the pages of its match, which have an address."""
    name = re.sub(r"[^a-z0-9]+", "-", match_id.lower()).strip("-")  # as keys of Prefect are
    match_page = f"{pages}/#/match/{quote(match_id, safe='')}"
    for key, text, address in (
        (f"review-{name}", f"Review {match_id}", match_page),
        ("status", "Status of all matches", f"{pages}/status"),
    ):
        try:
            create_link_artifact(address, text, key=key)
        except Exception as error:  # it stops nothing
            LOG.warning("not shown at Prefect: %s", error)


@flow(name="match", flow_run_name=_name_run, task_runner=RUNNER, validate_parameters=False)
def match(
    project: str,
    match_id: str,
    settings: dict[str, dict[str, JsonValue]] | None = None,
    from_stage: str | None = None,
    until_stage: str | None = None,
    gates: GatePolicy | None = None,
    iterations: IterationCount | None = None,
    time_limits: dict[str, float] | None = None,
) -> str:
    """Process a match and return the number of its run; suspended while results need review.

    A run waits for another one of the same match, and computes nothing if all results are current.

    Args:
        project: folder or URL of the store.
        match_id: a registered match.
        settings: stage to the settings that this run changes, and that the match keeps; the
            others are as its layers of settings say.
        from_stage: first stage to run; the latest run supplies earlier results.
        until_stage: last stage to run.
        gates: when results need review; as the layers say if None, else auto.
        iterations: number of iterations, the best of which is kept; as the layers say if None.
        time_limits: stage to the time limit of a unit [min], if not the default.

    Raises:
        IncompleteRunError: some units failed or were rejected; the others have their results.
        LostWorkersError: the Prefect server or Dask scheduler is gone; the run restarts.
    """
    logging.getLogger("worldpose").setLevel(logging.INFO)
    store = Store.open(project)
    request = RunRequest(
        settings or {},
        from_stage,
        until_stage,
        gates=gates,
        iterations=iterations,
        time_limits=time_limits or {},
    )
    runs = match_runs_of(store.url)
    if runs is not None:
        link_pages(runs.pages, match_id)
    with alone_with(store, match_id, wait=True):
        _, request = settle(store, open_match(store, match_id), request)
        request = replace(request, gates=request.gates or "auto")
        compute = _run_until_decided if request.most_iterations == 1 else _iterate_until_decided
        opened, record = compute(store, match_id, request)
        try:
            export_after_run(store, opened, record)
        except (WorldposeError, OSError):
            require_complete(record)  # its reason comes first
            raise
        return require_complete(record)


def _iterate_until_decided(
    store: Store, match_id: str, request: RunRequest
) -> tuple[Match, RunRecord]:
    """Iterate a match now and after each verdict; return it as it was at the end."""
    request, most = _on_own_workers(request), request.most_iterations
    while True:
        with reporting_to(Reporter()):
            opened = open_match(store, match_id)
            record = iterate_match(store, opened, request, most).record
        open_questions = waiting_for_verdicts(record.waiting)
        if record.failed or not open_questions:
            return opened, record
        take_verdict(store, match_id, open_questions)


def _run_until_decided(store: Store, match_id: str, request: RunRequest) -> tuple[Match, RunRecord]:
    """Do as `_iterate_until_decided` once; only plan it if the latest run has all results."""
    stages = selected_stages(request.from_stage, request.until_stage)
    policy: GatePolicy = request.gates or "auto"
    while True:
        opened, latest = open_match(store, match_id), latest_run(store, match_id)
        gatekeeper = Gatekeeper(store, opened, policy)
        plan = plan_ahead(gatekeeper, stages, request.settings, latest, request.iteration)
        if latest is not None and plan.is_recorded_by(latest):
            open_questions = waiting_for_verdicts(plan.waiting)
            if open_questions:
                take_verdict(store, match_id, open_questions)
                continue
            if latest.state == "complete" or (latest.state == "waiting" and not plan.waiting):
                return opened, latest
        with reporting_to(Reporter()):
            reporter().run_planned(expected_work(store, opened, plan.missing, latest))
            log = RunLog.begin(store, opened, stages, request.settings, policy, request.iteration)
            record = run_stages(log, request.time_limits)
        if record.failed or not waiting_for_verdicts(plan.of_its_part(record.waiting)):
            return opened, record


def _on_own_workers(request: RunRequest) -> RunRequest:
    """Return the request with the scheduler of this flow, which the flows inside it share."""
    context = FlowRunContext.get()
    client = getattr(context and context.task_runner, "client", None)
    if client is None:
        return request
    return replace(request, dask=client.scheduler.address, security=client.security)


@flow(name="ingest", flow_run_name=_name_run, validate_parameters=False)
def ingest(plan: dict[str, Any]) -> list[str]:
    """Register every complete arrival, and start a run for each; return their ids.

    Args:
        plan: a `ServePlan` as JSON.
    """
    LOG.setLevel(logging.INFO)
    served = ServePlan.model_validate(plan)

    def begin(opened: Match, arrival: Arrival) -> str:
        # After a kill, or for a moved folder, a second call returns the existing run.
        runs, key = MatchRuns.of_plan(served), run_key(opened, arrival)
        return runs.start(opened.match_id, priority=arrival.priority, key=key).flow_run

    decided = take_in(
        Store.open(served.project), served.state_folder, served.inbox, served.settle_seconds, begin
    )
    for arrival in decided:
        LOG.info("%s: %s %s", arrival.name, arrival.state, arrival.reason)
    return [arrival.match_id for arrival in decided if arrival.match_id]


class UnprocessedError(WorldposeError):
    """Some matches could not be checked; the others are current, or their runs are started."""


@flow(name="reprocess", flow_run_name=_name_run, validate_parameters=False)
def reprocess(
    project: str,
    matches: tuple[str, ...] | list[str] = (),
    settings: dict[str, dict[str, JsonValue]] | None = None,
    retry: bool = False,
    time_limits: dict[str, float] | None = None,
) -> dict[str, str]:
    """Start a run of every match with stale results, in the background; return each one's state.

    Nothing is started for a match without stale results, or whose run has not ended.

    Args:
        project: folder or URL of the store.
        matches: ids of registered matches; none = all.
        settings: stage to settings that override those of each match, and that it keeps.
        retry: retry failed units, even without an edit.
        time_limits: stage to the time limit of a unit [min], if not those of the service.

    Raises:
        UnprocessedError: some matches could not be checked; the others are started.
    """
    store = Store.open(project)
    runs = match_runs_of(store.url)
    if runs is None:
        raise WorldposeError(f"{project} is not served on this machine")
    request = RunRequest(settings or {})
    active = {run.match_id for run in runs.queue.open_runs() if run.flow == "match"}
    states: dict[str, str] = {}
    unchecked = []
    for each in reprocess_matches(store, matches, request, retry=retry, is_rehearsal=True):
        states[each.match_id] = each.state
        if each.problem:
            unchecked.append(f"{each.match_id}: {each.problem}")
        if each.status is None or each.state != "stale":
            continue
        if each.match_id in active:
            states[each.match_id] = "has a run"
            continue
        runs.start(
            each.match_id,
            priority="background",
            settings=None if settings is None else dict(settings),
            until_stage=each.status.until_stage,
            gates=each.status.gates,
            time_limits=None if time_limits is None else dict(time_limits),
        )
        states[each.match_id] = "started"
    if unchecked:
        raise UnprocessedError("; ".join(unchecked))
    return states


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
    run = open_run(project, opened.match_id)
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
    return str(folder)


def release_folder(store: Store, match_id: str, name: str, out: str | None) -> Path:
    """Return the output folder of a release.

    UsageError if the name is not valid for a folder, or the project is not in a local folder.
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


@flow(name="finetune", flow_run_name=_name_run, validate_parameters=False)
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
    from worldpose.training.settings import FineTuningSettings

    versions = fine_tune_nets.fn(  # in this flow, not as a subflow
        Path(annotations),
        None if pictures is None else Path(pictures),
        Path(project) / FOLDER,
        nets,
        FineTuningSettings.model_validate(settings or {}),
        {kind: Path(file) for kind, file in (starts or {}).items()},
    )
    return [version.file for version in versions]
