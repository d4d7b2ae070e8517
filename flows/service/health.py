"""Health checks of a served project, and how to fix each fault."""

from __future__ import annotations

import json
import os
import shutil
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final

from data_contracts.operations import Serving
from flows.orchestration.prefect_environment import CLIENT_LOGIN, SERVER_LOGIN, authorization
from flows.service.layout import StateFolder, is_alive
from flows.service.plan import FLOWS, deployment_names

WORKER_SECONDS: Final = 90.0
"""Without a heartbeat for so long, a worker counts as lost; it sends one every 30 s."""
LOW_DISK_GB: Final = 1.0
"""With less free space, computation will soon fail [GB]."""


@dataclass(frozen=True)
class Finding:
    """Check result of one part of the service.

    Attributes:
        part: its name.
        is_well: whether it works as expected.
        state: its state, as text.
        remedy: how to fix it if it does not work.
    """

    part: str
    is_well: bool
    state: str
    remedy: str = ""


def check(state: StateFolder) -> list[Finding]:
    """Check everything that `worldpose serve` runs, dependencies first."""
    serving = state.read_serving()
    with state.only_one("serve", wait=False) as is_free:
        pass
    if serving is None or is_free:
        was = "it was killed" if serving is not None else "it was not started, or ended"
        begin = "Begin it: worldpose serve, with the project and options that it should have."
        return [Finding("serve", False, f"nothing serves this project: {was}", begin)]
    pid = serving.services["serve"].pid
    found = [Finding("serve", True, f"process {pid}, since {serving.started_at:%Y-%m-%d %H:%M}Z")]
    found += _processes(state, serving)
    found += _check_answer(state, serving)
    found += at_prefect(serving, _login(state, serving))
    found += _inbox(state, serving)
    found.append(_disk(state.folder))
    return found


def _processes(state: StateFolder, serving: Serving) -> Iterator[Finding]:
    for name, service in serving.services.items():
        if name != "serve" and not is_alive(service.pid):
            log = state.logs / f"{name}.log"
            remedy = f"It restarts automatically; if it keeps ending, see {log}."
            yield Finding(name, False, "its process has ended", remedy)


def _check_answer(state: StateFolder, serving: Serving) -> Iterator[Finding]:
    addresses = {"prefect": f"{serving.prefect}/health"}
    for name, path in (("pages", "/api/health"), ("watch", "/health")):
        service = serving.services.get(name)
        if service is not None and service.address is not None:
            origin = "/".join(service.address.split("/")[:3])
            addresses[name] = origin.replace("0.0.0.0", "127.0.0.1") + path
    for name, address in addresses.items():
        problem = _ask(address)[1]
        if not problem:
            yield Finding(name, True, f"answers at {address}")
        elif name == "prefect" and not serving.owns_prefect:
            yield Finding(name, False, problem, f"Start the Prefect server at {serving.prefect}.")
        else:
            log = state.logs / f"{name}.log"
            yield Finding(name, False, problem, f"See {log}; end worldpose serve and begin again.")


def _login(state: StateFolder, serving: Serving) -> str | None:
    if not serving.owns_prefect:
        return os.environ.get(CLIENT_LOGIN)
    try:
        return os.environ.get(SERVER_LOGIN) or state.prefect_login.read_text().strip()
    except OSError:
        return None  # the check then reports that the server refuses


def at_prefect(serving: Serving, login: str | None = None) -> Iterator[Finding]:
    """Check that deployments exist, and that a worker takes their runs.

    Args:
        serving: the served project.
        login: login of clients at its server; None = it needs none.
    """
    again = "End worldpose serve and begin it again: it installs what is missing."
    ask = _ask if login is None else partial(_ask, login=login)
    deployments, problem = ask(
        f"{serving.prefect}/deployments/filter",
        {"deployments": {"name": {"any_": deployment_names(serving.name)}}},
    )
    if problem:
        variable = SERVER_LOGIN if serving.owns_prefect else CLIENT_LOGIN
        is_refused = problem.endswith(" 401")
        remedy = f"Set {variable} as it was when the service began." if is_refused else ""
        yield Finding("deployments", False, problem, remedy or "Fix prefect first.")
        return
    offered = {each["name"] for each in _flows(serving, deployments, ask)}
    missing = set(FLOWS) - offered
    words = f"missing: {', '.join(sorted(missing))}" if missing else ", ".join(sorted(offered))
    yield Finding("deployments", not missing, words, again)
    for pool in (serving.name, f"{serving.name}-arrivals"):
        address = f"{serving.prefect}/work_pools/{pool}/workers/filter"
        workers, problem = ask(address, {})
        seen = [_time(each["last_heartbeat_time"]) for each in workers or ()]
        silent = (datetime.now(UTC) - max(seen)).total_seconds() if seen else float("inf")
        is_well = not problem and silent < WORKER_SECONDS
        words = f"was heard of {silent:.0f} s ago" if seen else problem or "never heard of"
        yield Finding(f"worker of {pool}", is_well, words, f"See the log worker.log. {again}")
    late, problem = ask(
        f"{serving.prefect}/flow_runs/count",
        {
            "deployments": {"name": {"any_": deployment_names(serving.name)}},
            "flow_runs": {
                "state": {"name": {"any_": ["Running"]}},
                "expected_start_time": {
                    "before_": (datetime.now(UTC) - timedelta(days=1)).isoformat()
                },
            },
        },
    )
    if late:
        yield Finding(
            "runs",
            False,
            f"{late} seem to run for more than a day",
            f"Look at them at {serving.prefect.removesuffix('/api')}, and cancel what hangs.",
        )


def _flows(
    serving: Serving, deployments: list[Mapping[str, Any]], ask: Callable[..., tuple[Any, str]]
) -> list[Mapping[str, Any]]:
    ids = sorted({each["flow_id"] for each in deployments})
    asked = {"flows": {"id": {"any_": ids}}}
    flows, problem = ask(f"{serving.prefect}/flows/filter", asked)
    return [] if problem else flows


def _inbox(state: StateFolder, serving: Serving) -> Iterator[Finding]:
    inbox = Path(serving.inbox)
    if not os.access(inbox, os.R_OK | os.X_OK):
        remedy = f"Make the folder {inbox}, readable for this user."
        yield Finding("inbox", False, "cannot be read", remedy)
        return
    arrivals = list(state.arrivals().values())
    refused = [each for each in arrivals if each.state == "refused"]
    words = f"{len(arrivals)} known, {len(refused)} refused"
    yield Finding("inbox", True, words)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / 1e9
    remedy = "Free some: worldpose gc --keep-last 3 --delete."
    return Finding("disk", free >= LOW_DISK_GB, f"{free:.1f} GB free", remedy)


def _ask(
    address: str, body: Mapping[str, Any] | None = None, login: str | None = None
) -> tuple[Any, str]:
    """Request an address; return the response, and an error message if it failed."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    data = None if body is None else json.dumps(body).encode()
    headers = {"content-type": "application/json"}
    if login:
        headers["authorization"] = authorization(login)
    request = urllib.request.Request(address, data, headers)
    try:
        with opener.open(request, timeout=10) as answer:
            content = answer.read()
    except urllib.error.HTTPError as error:
        return None, f"{address} answers {error.code}"
    except (OSError, ValueError) as error:
        return None, f"{address} does not answer: {getattr(error, 'reason', error)}"
    return (json.loads(content) if body is not None else content), ""


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text.replace("Z", "+00:00"))
