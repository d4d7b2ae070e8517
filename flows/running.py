"""Running a match: plan first, then start only the machines that the plan needs."""

from __future__ import annotations

import importlib
import os
import signal
import threading
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, cast

from pydantic import JsonValue

from data_contracts.run import GatePolicy, RunRecord
from data_contracts.settings import IterationCount
from flows.gates import Gatekeeper
from flows.layers import ENVIRONMENT, SETTINGS_LOCK, Layer, check_general, read_layers, write_layer
from flows.method import METHOD, task_modules
from flows.orchestration.local_cluster import (
    keep_workers,
    require_room,
    require_workers,
    start_cluster,
    wait_for_worker,
    workers_for,
)
from flows.orchestration.prefect_environment import has_server, prefect_server
from flows.overview import make_summary
from flows.progress import reporter
from flows.run_plan import PlannedUnit, plan_ahead
from flows.run_record import RunLog, expected_work, latest_run
from flows.run_status import last_stage
from flows.settings import (
    Overrides,
    ResolvedSettings,
    TimeLimits,
    as_text,
    flatten,
    resolve,
    selected_stages,
    settings_of,
)
from flows.stage import Match
from tasks.tracing import flush_spans, start_tracing
from worldpose.body.body_file import is_open_body
from worldpose.errors import InputError, UsageError, WorldposeError
from worldpose.store.runs import alone
from worldpose.store.store import Store

if TYPE_CHECKING:
    from distributed import Security
    from prefect.task_runners import TaskRunner

    from flows.orchestration.private_cluster import PrivateCluster

DASK_SECONDS = 10.0
"""Timeout of a Dask scheduler's answer."""


@dataclass(frozen=True)
class RunRequest:
    """Options of a run.

    Attributes:
        settings: stage to the settings that the run states, which its match keeps; all settings
            of the run once it is settled (`settle`).
        from_stage: first stage; the latest run supplies earlier results.
        dask: address of a running Dask scheduler; None starts workers on this machine.
        workers: number of worker processes on this machine; None = one per core, as far as there is
            work for them.
        gates: when results need review; None = as the layers say, or as in the latest run while
            that waits or did not reach the last stage, or never.
        iteration: iteration number of the whole method, whose previous iterations have results; a
            part continues the latest run's.
        time_limits: stage to the time limit of a unit [min], if not the default.
        security: TLS certificate for the scheduler at `dask`; None = Dask's configuration.
        default_settings: whether the match forgets what earlier runs stated.
        iterations: number of iterations, which its match keeps; None = as the layers say.
        body_folder: folder of installed bodies, which its match keeps; None = as the layers say.
        is_settled: whether the request has all settings of the run.
    """

    settings: Overrides
    from_stage: str | None = None
    until_stage: str | None = None
    dask: str | None = None
    workers: int | None = None
    gates: GatePolicy | None = None
    iteration: int = 1
    time_limits: TimeLimits = field(default_factory=dict)
    security: Security | None = None
    default_settings: bool = False
    iterations: IterationCount | None = None
    body_folder: str | None = None
    is_settled: bool = False

    @property
    def most_iterations(self) -> int | None:
        """Maximum number of iterations of a settled request; None = until one is no better."""
        return self.iterations if isinstance(self.iterations, int) else None

    def gate_policy(self, match: Match, latest: RunRecord | None) -> GatePolicy:
        """Return when results need review, for a match with this latest run."""
        if self.gates or latest is None:
            return self.gates or "never"
        # What has not come to the end is a step of the run that does, which asks as it did.
        is_open = latest.state != "complete" or last_stage(match, latest) is not None
        return latest.gates if is_open else "never"


def settle(store: Store, match: Match, request: RunRequest) -> tuple[Match, RunRequest]:
    """Return the match and the request with all settings of the run, and report those not stated.

    Every door calls this, and only this decides the settings of a run: a value is that of the last
    of the layers built in, project, venue and match which states it. What the request states
    becomes the layer of the match, so that later runs keep it. InputError if a layer is invalid,
    UsageError if the request is.
    """
    if request.is_settled:
        return match, request
    is_part = selected_stages(request.from_stage, request.until_stage) != METHOD
    if request.iterations not in (None, 1):
        require_whole(request)
    stated = flatten(request.settings)
    stated |= {} if request.iterations is None else {"iterations": request.iterations}
    stated |= {} if request.body_folder is None else {"body_folder": request.body_folder}
    checked: tuple[Layer, ...] | None = None
    while True:
        with alone(store.blobs, SETTINGS_LOCK, wait=True):
            *others, own = read_layers(store, match.registration.spec)  # it can have changed since
            check_general(own.name, "the request", stated)
            kept = {
                name: value
                for name, value in own.values.items()
                if not request.default_settings
                or ("." not in name and name not in ("iterations", "body_folder"))
            }
            values = {**kept, **stated}
            found = resolve([*others, replace(own, values=values)])
            folder = found.origins.get("body_folder")
            models = [each.get("body_model") for each in found.overrides.values()]
            needs_bodies = any(isinstance(it, str) and not is_open_body(it) for it in models)
            if folder is not None and folder.name == ENVIRONMENT and needs_bodies:
                # Another shell, or the service, may not have the variable.
                values["body_folder"] = folder.values["body_folder"]
            settled = replace(match, layers=(*others, replace(own, values=values)))
            if values == own.values:
                break
            if settled.layers == checked:
                write_layer(store, own.name, values)
                _report_lost(own, values)
                break
        # Not while the lock is held: a disk of what it reads may not answer. Else nothing is kept.
        _require_usable(settled, request, found.overrides)
        checked = settled.layers
    _report_settings(found, {*stated}, latest_run(store, match.match_id))
    return settled, replace(
        request,
        settings=found.overrides,
        gates=request.gates or found.general.gates,
        iterations=request.iterations or (1 if is_part else found.general.iterations),
        is_settled=True,
    )


def _report_lost(own: Layer, values: Mapping[str, JsonValue]) -> None:
    """Report what a match's layer has lost, of which only `values` are left."""
    for name, was in own.values.items():
        if name not in values:
            said = f"--default-settings removes {name}={as_text(was)}"
        elif values[name] != was:
            said = f"{name}={as_text(values[name])} replaces {as_text(was)}"
        else:
            continue
        text = f"{own.name.partition('/')[2]}: {said}, which the settings of the match stated"
        reporter().tell_kept_settings(text)


def require_whole(request: RunRequest) -> None:
    """Refuse iterations of a part of the method."""
    if selected_stages(request.from_stage, request.until_stage) != METHOD:
        raise UsageError(
            "--iterations",
            expected="the whole method",
            found="--from or --until",
            todo="Omit --from and --until, or omit --iterations.",
        )


def _require_usable(match: Match, request: RunRequest, overrides: Overrides) -> None:
    """Refuse a missing file that the stages of a request use, or one that it states itself."""
    if request.body_folder is not None and not Path(request.body_folder).is_dir():
        found, todo = f"no folder {request.body_folder}", "Install a body there, or name another."
        raise UsageError("--body-folder", "a folder with installed bodies", found, todo)
    part = selected_stages(request.from_stage, request.until_stage)
    for stage in selected_stages(None, request.until_stage):
        is_used = stage in part and stage.units(match)
        if is_used or stage.name in request.settings:
            stage.external_inputs(match, settings_of(stage, overrides))


def _report_settings(
    found: ResolvedSettings, stated: Container[str], latest: RunRecord | None
) -> None:
    """Report the settings that the command does not state, and those that the latest run had."""
    kept = [
        f"{name}={as_text(each['value'])} ({each['from']})"
        for name, each in found.differences().items()
        if name not in stated
    ]
    if kept:
        reporter().tell_kept_settings(f"settings: {', '.join(kept)}; see worldpose settings")
    before = {} if latest is None else flatten(latest.overrides)
    gone = [f"{name}={as_text(it)}" for name, it in before.items() if name not in found.values]
    if latest is not None and gone:
        reporter().tell_kept_settings(
            f"settings of run {latest.run_id} that no layer states now: {', '.join(gone)}"
        )


def run_match(store: Store, match: Match, request: RunRequest) -> RunRecord:
    """Run a match until its results are current; return the run's record.

    If nothing is stale, this is the latest run's record, and neither Prefect nor Dask starts; the
    same holds if all runnable units wait for review. UsageError for an unknown stage, or no results
    to start `from_stage` from; InputError if the given Dask scheduler or Prefect server does not
    answer; LostWorkersError if it stopped answering during the run.
    """
    stages = selected_stages(request.from_stage, request.until_stage)
    match, request = settle(store, match, request)
    latest = latest_run(store, match.match_id)
    policy = request.gate_policy(match, latest)
    gatekeeper = Gatekeeper(store, match, policy)
    plan = plan_ahead(gatekeeper, stages, request.settings, latest, request.iteration)
    reporter().run_planned(expected_work(store, match, plan.missing, latest))
    if plan.missing:
        return _with_prefect(store, match, replace(request, gates=policy), plan.missing)
    if latest is not None and plan.is_recorded_by(latest):
        reused = tuple(sorted(plan.results))
        asked = {unit.request: unit for unit in (*latest.waiting, *plan.waiting)}
        return latest.model_copy(
            update={
                "executed": (),
                "reused": reused,
                "gates": policy,
                "waiting": tuple(asked.values()),
            }
        )
    log = RunLog.begin(store, match, stages, request.settings, policy, request.iteration)
    record = log.run_stages(compute=lambda stage, units: ())  # all results exist
    make_summary(store, record.match_id)
    return record


def _with_prefect(
    store: Store, match: Match, request: RunRequest, missing: list[PlannedUnit]
) -> RunRecord:
    with shared_machines(store, request) as machines_for:
        request = machines_for(missing)
        from prefect.logging.handlers import APILogHandler
        from prefect_dask import DaskTaskRunner

        from flows.match import IncompleteRunError, process_match

        start_tracing()
        client = {} if request.security is None else {"security": request.security}
        runner = cast("TaskRunner[Any]", DaskTaskRunner(address=request.dask, client_kwargs=client))
        try:
            run_id = process_match.with_options(task_runner=runner)(
                project=store.url,
                match_id=match.match_id,
                settings={stage: dict(values) for stage, values in request.settings.items()},
                from_stage=request.from_stage,
                until_stage=request.until_stage,
                gates=request.gates,
                iteration=request.iteration,
                time_limits=dict(request.time_limits),
            )
        except IncompleteRunError as failure:
            run_id = failure.run_id
        except Exception as failure:
            require_room(failure, store.url)
            require_workers(failure)
            raise
        finally:
            flush_spans()
            APILogHandler().flush()  # while the server can still accept the last lines
    return store.run(match.match_id, run_id)


@contextmanager
def shared_machines(
    store: Store, request: RunRequest
) -> Iterator[Callable[[Iterable[PlannedUnit]], RunRequest]]:
    """Yield a function that adds a shared server and workers to the request of each run inside.

    Starting them takes seconds, and Prefect keeps its first server address. They start when the
    function first gets units to compute, as many workers as those need; more are added if later
    units need more.
    """
    with ExitStack() as stack:
        started: list[tuple[RunRequest, Callable[[int], None]]] = []

        def machines_for(missing: Iterable[PlannedUnit]) -> RunRequest:
            units = list(missing)
            if units and not started:
                started.append(stack.enter_context(_machines(store, request, units)))
            elif units:
                _, ask_for = started[0]
                ask_for(workers_for(request.workers, units))
            return started[0][0] if started else request

        yield machines_for


@contextmanager
def _machines(
    store: Store, request: RunRequest, missing: list[PlannedUnit]
) -> Iterator[tuple[RunRequest, Callable[[int], None]]]:
    """Yield the request with server and workers, and a function that asks for more workers."""
    is_watched = has_server()
    if request.dask is None or not is_watched:
        reporter().say("starting Prefect and Dask")
    server = prefect_server(is_local=request.dask is None)
    with end_at_once(), server as wait_until_ready, ExitStack() as stack:
        cluster: PrivateCluster | None = None
        # An external cluster has a fixed number of workers.
        ask_for: Callable[[int], None] = lambda workers: None  # noqa: E731
        if request.dask is None:
            # Entering the cluster itself would wait for its workers.
            cluster = stack.enter_context(closing(start_cluster(request.workers, missing)))
            ask_for = stack.enter_context(keep_workers(cluster))
            request = replace(request, dask=cluster.scheduler_address, security=cluster.security)
        else:
            _require_scheduler(request.dask, request.security)
        # Imported here: it takes seconds, while server and workers start.
        importlib.import_module("flows.match")

        if not is_watched:  # no heartbeats, for which each run would wait one second at its end
            from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

            stack.enter_context(temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}))
        try:
            wait_until_ready()
        except WorldposeError as failure:
            require_room(failure, store.url)
            raise
        if cluster is not None:
            # What the flow would import when it starts and with each stage's first unit: a core is
            # idle until the first worker has started.
            tasks = task_modules(unit.recipe.stage for unit in missing)
            for name in ("prefect.flow_engine", "prefect_dask", "tasks.batch", *tasks):
                importlib.import_module(name)
            wait_for_worker(cluster)
        yield request, ask_for


@contextmanager
def end_at_once() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the run at once.

    A killed run keeps its finished results, and its workers and server end with it. An orderly
    shutdown would wait for running tasks, which can take minutes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals go to the main thread, whose owner handles them
        return

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C does not tear the last line
        try:
            reporter().report_interruption()
        finally:
            os._exit(128 + number)

    _start_quiet_tracker()
    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _start_quiet_tracker() -> None:
    """Start Python's resource tracker, which warns of what an ended run leaves and it removes."""
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore:resource_tracker"
    try:
        ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before


def _require_scheduler(address: str, security: Security | None) -> None:
    from distributed import Client

    client = {} if security is None else {"security": security}
    try:
        Client(address, timeout=DASK_SECONDS, set_as_default=False, **client).close()
    except (OSError, ValueError, TypeError) as error:
        if isinstance(error, TypeError) and not address.startswith("tls://"):
            raise  # of TLS, distributed says so that no certificate is configured
        raise InputError(
            f"--dask {address}",
            expected="a running Dask scheduler, as tcp://host:port",
            found=str(error).splitlines()[0],
            todo="Start a scheduler: dask scheduler.",
        ) from None
