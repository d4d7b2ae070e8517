"""Process supervisor of a served project: ordered start, restarts, and shutdown."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Final
from urllib.parse import urlsplit

from data_contracts.operations import Service, Serving
from flows.orchestration.prefect_api import PrefectApi
from flows.orchestration.prefect_environment import (
    begin_database,
    keep_database,
    one_authority,
    problem_at,
    require_login,
    served_environment,
)
from flows.service.health import BEGIN_SECONDS, at_prefect, of_other_project
from flows.service.layout import PRIORITIES
from flows.service.plan import Secrets, ServePlan
from flows.web.http_server import require_free_ports
from worldpose.errors import UsageError, WorldposeError
from worldpose.store.blobs import storage_errors
from worldpose.store.store import Store

LONGEST_PAUSE: Final = 60.0
"""Between two starts of a process that keeps ending [s]."""
STEADY_SECONDS: Final = 120.0
"""A process that ran for so long is restarted at once."""
END_SECONDS: Final = 15.0
"""Time to end before a process is killed."""
LOG_BYTES: Final = 10_000_000
"""A longer log is moved to `.1`, also while its process runs."""

Tell = Callable[[str], None]


@dataclass
class _Part:
    """A supervised process.

    It has no process until its restart. `said` is the size of its log before the start [byte];
    `began` and `due` are on the monotonic clock [s].
    """

    name: str
    address: str | None
    log: Path
    process: subprocess.Popen[bytes] | None = None
    said: int = 0
    began: float = 0.0
    pause: float = 0.0
    due: float = 0.0

    def wait_until(self, is_well: Callable[[], bool], told: threading.Event) -> None:
        """Wait until it is well, or the service is told to end."""
        deadline = time.monotonic() + BEGIN_SECONDS
        while not told.wait(0.2):
            has_ended = self.process is None or self.process.poll() is not None
            if has_ended or time.monotonic() > deadline:
                said = self.log.read_bytes()[self.said :].decode(errors="replace")
                raise WorldposeError(f"{self.name} did not start. It said:\n{said[-2000:]}")
            if is_well():
                return


@dataclass
class _Supervisor:
    """Keeps the parts running."""

    plan: ServePlan
    secrets: Secrets
    tell: Tell
    parts: list[_Part] = field(default_factory=list)
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))

    def start(self, name: str, address: str | None = None) -> _Part:
        part = _Part(name, address, self.plan.state_folder.logs / f"{name}.log")
        self.parts.append(part)
        self._begin(part)
        return part

    def look(self) -> None:
        """Restart parts that have ended."""
        now = time.monotonic()
        for part in self.parts:
            bound_log(part.log)
            if part.process is not None and part.process.poll() is not None:
                code = part.process.returncode
                is_steady = now - part.began > STEADY_SECONDS
                part.pause = 0.0 if is_steady else min(2.0 * part.pause + 1.0, LONGEST_PAUSE)
                part.due, part.process = now + part.pause, None
                self.tell(
                    f"{part.name} ended ({code}), see {part.log}; it restarts in {part.pause:.0f} s"
                )
            elif part.process is None and now >= part.due:
                self._begin(part)
                self.write()

    def write(self) -> Serving:
        """Write the plan and processes to the state folder."""
        plan = self.plan
        services = {
            part.name: Service(pid=part.process.pid, address=part.address)
            for part in self.parts
            if part.process is not None
        }
        serving = Serving(
            project=plan.project,
            inbox=str(plan.inbox),
            name=plan.name,
            prefect=plan.prefect,
            owns_prefect=plan.owns_prefect,
            certificate=None if plan.certificate is None else str(plan.certificate.resolve()),
            services={**services, "serve": Service(pid=os.getpid())},
            started_at=self.started_at,
        )
        plan.state_folder.write_serving(serving)
        return serving

    def end(self) -> None:
        """End all parts in reverse order: runs end before the server that they report to.

        A part that waits for a disk is left behind: it ends when the disk answers.
        """
        for part in reversed(self.parts):
            process, part.process = part.process, None
            if process is None:
                continue
            if process.stdin is not None:
                process.stdin.close()
            try:
                process.wait(END_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                try:
                    process.wait(END_SECONDS)
                except subprocess.TimeoutExpired:
                    self.tell(f"{part.name} ends when its disk answers: process {process.pid}")

    def _begin(self, part: _Part) -> None:
        part.log.parent.mkdir(parents=True, exist_ok=True)
        bound_log(part.log)
        child = [sys.executable, "-m", "flows.service.child"]
        with part.log.open("ab") as output:
            part.said = output.tell()
            # Requests come in forty threads, each of which would keep memory of its own.
            few = {} if part.name == "worker" else {"MALLOC_ARENA_MAX": "2"}
            part.process = subprocess.Popen(
                [*child, part.name, self.plan.model_dump_json()],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment_of(self.plan) | few | self.secrets.of(part.name, self.plan),
                start_new_session=True,  # Ctrl-C is for this process, which then ends its parts
            )
        part.began = time.monotonic()


def serve(plan: ServePlan, secrets: Secrets, ready: Callable[[], None], tell: Tell) -> None:
    """Serve a project until SIGINT or SIGTERM.

    `ready` is called when all parts answer; `tell` receives lines for the operator. InputError if a
    port is taken, UsageError if the project is already served, WorldposeError if a part does not
    answer in time.
    """
    Store.create(plan.project)
    state = plan.state_folder
    queues = ["" if priority == "normal" else priority for priority in PRIORITIES]
    for folder in (*(plan.inbox / each for each in queues), state.folder):
        with storage_errors(str(folder)):
            folder.mkdir(parents=True, exist_ok=True)
    with state.only_one("serve", wait=False) as is_alone:
        if not is_alone:
            raise UsageError(
                f"worldpose serve --project {plan.project}",
                expected="nothing that serves this project yet",
                found=f"another process; see {state.serving}",
                todo="Read its state with --check, or end it first.",
            )
        _require_free_ports(plan)
        with _until_told() as told:
            supervisor = _Supervisor(plan, secrets, tell)
            try:
                _bring_up(supervisor, told)
                if not told.is_set():
                    ready()
                while not told.wait(0.5):
                    supervisor.look()
            finally:
                supervisor.end()
                state.end_orderly()
                state.serving.unlink(missing_ok=True)


def _require_free_ports(plan: ServePlan) -> None:
    numbers = {"--port": plan.pages_port, "--metrics-port": plan.metrics_port}
    ports = {option: (plan.host, number) for option, number in numbers.items()}
    if plan.owns_prefect:
        address = urlsplit(plan.prefect)
        ports["--prefect-port"] = (address.hostname or "127.0.0.1", address.port or 80)
    require_free_ports(ports)


def bound_log(log: Path) -> None:
    """Move a log that is too long aside, replacing the previous one.

    Its process keeps the file open in append mode, and continues at its start.
    """
    if not log.exists() or log.stat().st_size <= LOG_BYTES:
        return
    with suppress(OSError):  # on a full disk the log frees space
        shutil.copyfile(log, log.with_suffix(".log.1"))
    os.truncate(log, 0)


def _bring_up(supervisor: _Supervisor, told: threading.Event) -> None:
    plan, state = supervisor.plan, supervisor.plan.state_folder
    local = "127.0.0.1" if plan.host in ("0.0.0.0", "::") else plan.host

    def wait_for(part: _Part, health: str) -> None:
        part.wait_until(lambda: not problem_at(health), told)

    if plan.owns_prefect:
        is_first = begin_database(plan.state / "prefect")
        wait_for(supervisor.start("prefect", plan.prefect), f"{plan.prefect}/health")
        if is_first and not told.is_set():
            keep_database(plan.state / "prefect")
    elif problem_at(f"{plan.prefect}/health"):
        raise UsageError(
            f"PREFECT_API_URL={plan.prefect}",
            expected="a running Prefect server",
            found="no answer",
            todo="Start the server, or unset PREFECT_API_URL: then worldpose starts one.",
        )
    else:
        require_login(plan.prefect)
    prefect = PrefectApi(plan.prefect, supervisor.secrets.prefect)
    if not told.is_set() and (refusal := of_other_project(prefect, plan, state)):
        raise refusal
    pages = supervisor.start("pages", plan.pages)
    worker = supervisor.start("worker")
    watch = supervisor.start("watch", f"http://{plan.host}:{plan.metrics_port}/metrics")
    serving = supervisor.write()
    if plan.certificate is None:
        wait_for(pages, f"http://{local}:{plan.pages_port}/api/health")
    wait_for(watch, f"http://{local}:{plan.metrics_port}/health")

    worker.wait_until(lambda: all(it.is_well for it in at_prefect(state, serving)), told)


def environment_of(plan: ServePlan) -> dict[str, str]:
    """Return the environment of all parts of a served project; it contains no secrets."""
    home = plan.state / "prefect" if plan.owns_prefect else None
    values = served_environment(plan.prefect, home)
    workers = plan.workers or max(1, (os.cpu_count() or 1) // plan.max_concurrent)
    values["WORLDPOSE_STATE"] = str(plan.state)
    values |= {
        "PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED": "events,flow_runs",
        "PREFECT_SERVER_SERVICES_DB_VACUUM_RETENTION_PERIOD": f"{86400.0 * plan.history_days:.0f}",
    }
    values["WORLDPOSE_WORKERS"] = str(workers)
    if plan.dask is not None:
        values["WORLDPOSE_DASK"] = plan.dask
    elif home is not None:
        home.mkdir(parents=True, exist_ok=True)
        values |= one_authority(home)
    return values


@contextmanager
def _until_told() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set inside the block."""
    told = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        told.set()

    before = {each: signal.signal(each, end) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
