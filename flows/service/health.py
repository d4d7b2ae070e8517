"""Health checks of a served project, and how to fix each fault."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from data_contracts.operations import Serving
from flows.orchestration.prefect_api import PrefectApi, UnreachablePrefectError, parse_time
from flows.orchestration.prefect_environment import CLIENT_LOGIN, SERVER_LOGIN, problem_at
from flows.service.alerts import STANDSTILLS, kept_alerts
from flows.service.layout import StateFolder, disk_answers, is_alive
from flows.service.plan import FLOWS, ServePlan, deployment_name
from worldpose.errors import InputError

WORKER_SECONDS: Final = 90.0
"""Without a heartbeat for so long, a worker counts as lost; it sends one every 30 s."""
BEGIN_SECONDS: Final = 300.0
"""Start timeout: the first start creates a database, and machines are busy [s]."""
LOW_DISK_GB: Final = 1.0
"""With less free space, computation will soon fail [GB]."""
AGAIN: Final = "End worldpose serve and begin it again: it installs what is missing."


@dataclass(frozen=True)
class Finding:
    """Check result of one part of the service."""

    part: str
    is_well: bool
    state: str
    remedy: str = ""


def check(state: StateFolder) -> list[Finding]:
    """Check everything that `worldpose serve` runs, dependencies first."""
    serving, is_held = state.read_serving(), state.is_held("serve")
    if serving is None and is_held:
        return [Finding("serve", False, "it starts", "Wait until it has printed its addresses.")]
    if serving is None or not is_held:
        was = "it was killed" if serving is not None else "it was not started, or ended"
        begin = "Begin it: worldpose serve, with the project and options that it should have."
        return [Finding("serve", False, f"nothing serves this project: {was}", begin)]
    pid = serving.services["serve"].pid
    found = [Finding("serve", True, f"process {pid}, since {serving.started_at:%Y-%m-%d %H:%M}Z")]
    found += _check_processes(state, serving)
    found += _check_servers(state, serving)
    found += at_prefect(state, serving)
    seconds = (datetime.now(UTC) - serving.started_at).total_seconds()
    if seconds < BEGIN_SECONDS:
        wait = f"It began {seconds:.0f} s ago, and may still start: wait, and check again. If not: "
        found = [it if it.is_well else replace(it, remedy=wait + it.remedy) for it in found]
    found += _check_progress(state)
    found.append(_check_inbox(state, serving))
    free = shutil.disk_usage(state.folder).free / 1e9
    remedy = "Free some: worldpose gc --keep-last 3 --delete."
    found.append(Finding("disk", free >= LOW_DISK_GB, f"{free:.1f} GB free", remedy))
    return found


def _check_processes(state: StateFolder, serving: Serving) -> Iterator[Finding]:
    for name, service in serving.services.items():
        if name != "serve" and not is_alive(service.pid):
            log = state.logs / f"{name}.log"
            remedy = f"It restarts automatically; if it keeps ending, see {log}."
            yield Finding(name, False, "its process has ended", remedy)


def _check_servers(state: StateFolder, serving: Serving) -> Iterator[Finding]:
    addresses = {"prefect": f"{serving.prefect}/health"}
    for name, path in (("pages", "/api/health"), ("watch", "/health")):
        service = serving.services.get(name)
        if service is not None and service.address is not None:
            origin = "/".join(service.address.split("/")[:3])
            addresses[name] = origin.replace("0.0.0.0", "127.0.0.1") + path
    for name, address in addresses.items():
        problem = problem_at(address, serving.certificate if name == "pages" else None)
        if not problem:
            yield Finding(name, True, f"answers at {address}")
        elif name == "prefect" and not serving.owns_prefect:
            yield Finding(name, False, problem, f"Start the Prefect server at {serving.prefect}.")
        else:
            log = state.logs / f"{name}.log"
            yield Finding(name, False, problem, f"See {log}; end worldpose serve and begin again.")


def of_other_project(
    prefect: PrefectApi, serving: Serving | ServePlan, state: StateFolder
) -> InputError | None:
    """Return the refusal of a server where another project has deployments of this name."""
    name = deployment_name(serving.name, "match")
    there = prefect.deployment(name)
    if there is None or there["parameters"].get("project") == serving.project:
        return None
    return InputError(
        f"deployment {name} at {serving.prefect}",
        expected=f"that of project {serving.project}",
        found=f"that of {there['parameters'].get('project')}",
        todo=(
            f"Was the project moved? Move it back, or remove {state.folder}: nothing is lost "
            "but Prefect's history, and what lies in the inbox is taken in once more."
            if serving.owns_prefect
            else "Give this project's deployments another name with --name."
        ),
    )


def at_prefect(state: StateFolder, serving: Serving) -> Iterator[Finding]:
    """Check that its own deployments exist, and that a worker takes their runs."""
    prefect = PrefectApi(serving.prefect, state.client_login(serving), tries=1)
    try:
        names = {flow: deployment_name(serving.name, flow) for flow in FLOWS}
        missing = [flow for flow, name in names.items() if prefect.deployment(name) is None]
        words = f"missing: {', '.join(missing)}" if missing else ", ".join(FLOWS)
        if (refusal := of_other_project(prefect, serving, state)) is not None:
            words = f"expected {refusal.expected}, found {refusal.found}"
            yield Finding("deployments", False, words, refusal.todo)
        else:
            yield Finding("deployments", not missing, words, AGAIN)
        for pool in (serving.name, f"{serving.name}-arrivals"):
            yield check_worker(prefect, pool)
    except UnreachablePrefectError as error:
        variable = SERVER_LOGIN if serving.owns_prefect else CLIENT_LOGIN
        remedy = "Fix prefect first; if it is well, it is busy: check again."
        if error.status == 401:
            remedy = f"Set {variable} as it was when the service began."
        yield Finding("deployments", False, f"unknown: Prefect's API {error.problem}", remedy)


def check_worker(prefect: PrefectApi, pool: str) -> Finding:
    """Check that Prefect hears of the worker of a pool."""
    remedy = f"See the log worker.log. {AGAIN}"
    if prefect.find(f"/work_pools/{pool}") is None:
        return Finding(f"worker of {pool}", False, "its pool is missing", remedy)
    workers = prefect.ask(f"/work_pools/{pool}/workers/filter", {})
    seen = [parse_time(each["last_heartbeat_time"]) for each in workers]
    silent = (datetime.now(UTC) - max(seen)).total_seconds() if seen else float("inf")
    words = f"was heard of {silent:.0f} s ago" if seen else "never heard of"
    return Finding(f"worker of {pool}", silent < WORKER_SECONDS, words, remedy)


def _check_progress(state: StateFolder) -> Iterator[Finding]:
    """Tell the alerts about what makes no progress, as the watcher sees it."""
    for alert in kept_alerts(state).values():
        if alert["alert"] in STANDSTILLS:
            remedy = f"See {alert['link']}, and the logs in {state.logs}."
            yield Finding("progress", False, alert["text"], remedy)


def _check_inbox(state: StateFolder, serving: Serving) -> Finding:
    inbox = Path(serving.inbox)
    if not disk_answers(inbox):
        remedy = f"Look after the disk of {inbox}, or the network to it."
        return Finding("inbox", False, "its disk does not answer", remedy)
    if not os.access(inbox, os.R_OK | os.X_OK):
        remedy = f"Make the folder {inbox}, readable for this user."
        return Finding("inbox", False, "cannot be read", remedy)
    arrivals = list(state.arrivals().values())
    refused = [each for each in arrivals if each.state == "refused"]
    return Finding("inbox", True, f"{len(arrivals)} known, {len(refused)} refused")
