"""The one way in which a served project runs a match: a run of its Prefect deployment.

Pages, inbox and schedules create such runs here, and Prefect's own form creates them there: all
have the worker, queues, limits and links of the deployment. Requests are plain HTTP, because
importing Prefect takes the pages seconds.
"""

from __future__ import annotations

import json
import logging
import os
import re
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final
from urllib.parse import quote, urlsplit

from pydantic import JsonValue

from data_contracts.operations import Priority, Serving
from flows.orchestration.prefect_environment import CLIENT_LOGIN, CLOUD_LOGIN, authorization
from flows.orchestration.result_pages import PAGE, page_offsets
from flows.run_record import runs_at_work
from flows.service.layout import StateFolder, is_alive, served_state
from flows.service.plan import deployment_name, deployment_names
from worldpose.errors import WorldposeError
from worldpose.store.store import Store

LOG: Final = logging.getLogger("worldpose.operations")
ANSWER_SECONDS: Final = 20.0
"""Timeout of Prefect's answer."""
LOOK_SECONDS: Final = 1.0
"""Between two looks for the end of another run [s]."""
SOON: Final = timedelta(minutes=1)
"""A run that is due later waits for its time, not for its turn."""
QUEUED: Final = ("SCHEDULED", "PENDING")
AT_WORK: Final = ("RUNNING", "CANCELLING")
ACTIVE: Final = (*QUEUED, *AT_WORK, "PAUSED")
ENDED: Final = ("COMPLETED", "FAILED", "CRASHED", "CANCELLED")


@dataclass(frozen=True)
class MatchRun:
    """A run of the deployment that processes matches.

    Attributes:
        id: Prefect's id.
        name: Prefect's name.
        match_id: its match.
        state: type of its state, as `RUNNING`.
        message: message of its state.
        link: its page in Prefect's dashboard.
        is_due: whether its time has come; a run of a schedule is created long before it.
        ended_at: when it ended; None = not yet.
    """

    id: str
    name: str
    match_id: str
    state: str
    message: str
    link: str
    is_due: bool = True
    ended_at: datetime | None = None

    @property
    def is_ahead(self) -> bool:
        """Whether it takes a place of the worker before later runs."""
        return self.state != "PAUSED"


class UnreachablePrefectError(WorldposeError):
    """The Prefect server does not answer, or refuses."""


@dataclass(frozen=True)
class MatchRuns:
    """Runs of matches of one served project.

    Attributes:
        api: address of Prefect's API.
        name: name of the project's deployments.
        login: login at Prefect's server; None = it needs none.
        pages: address of the review pages, to which runs link; empty if unknown.
        tries: requests to a server that does not answer or whose database is busy.
    """

    api: str
    name: str
    login: str | None = None
    pages: str = ""
    tries: int = 4

    def start(
        self,
        match_id: str,
        *,
        priority: Priority = "normal",
        key: str | None = None,
        **parameters: JsonValue,
    ) -> MatchRun:
        """Create a run of a match; the worker starts it in its turn.

        Args:
            match_id: a registered match.
            priority: queue of the run.
            key: a second call with the same key returns the run of the first; None = always new.
            **parameters: parameters of the flow other than the match; None leaves the default.

        Raises:
            UnreachablePrefectError: no run was created.
        """
        deployment = self._ask(f"/deployments/name/{quote(deployment_name(self.name, 'match'))}")
        given = {name: value for name, value in parameters.items() if value is not None}
        created = self._ask(
            f"/deployments/{deployment['id']}/create_flow_run",
            {
                "name": run_name(match_id),
                "parameters": {"match_id": match_id, **given},
                "tags": [priority],
                "work_queue_name": priority,
                # A request that is repeated after a lost answer creates no second run.
                "idempotency_key": key or f"once-{uuid.uuid4()}",
            },
        )
        run = self._run(created)
        self.link_pages(run.id, match_id)
        return run

    def link_pages(self, run_id: str, match_id: str) -> None:
        """Link a run to the pages of its match, once; a failure is logged and stops nothing."""
        if not self.pages:
            return
        links = {
            f"review-{artifact_key(match_id)}": (
                f"Review {match_id}",
                f"{self.pages}/#/match/{quote(match_id, safe='')}",
            ),
            "status": ("Status of all matches", f"{self.pages}/status"),
        }
        try:
            there = self._all("artifacts", artifacts={"flow_run_id": {"any_": [run_id]}})
            for key in links.keys() - {artifact["key"] for artifact in there}:
                text, address = links[key]
                artifact = {"key": key, "type": "markdown", "data": f"[{text}]({address})"}
                self._ask("/artifacts/", {**artifact, "flow_run_id": run_id})
        except UnreachablePrefectError as error:
            LOG.warning("the run of %s is not linked to its pages: %s", match_id, error)

    def active(self) -> list[MatchRun]:
        """Return all runs that have not ended, first to last, without those of a later time."""
        runs = self._list({"state": {"type": {"any_": ACTIVE}}}, "expected_start_time")
        return [run for run in runs if run.is_due or run.state != "SCHEDULED"]

    def ended_runs(self, since: datetime) -> list[MatchRun]:
        """Return all runs that have ended since a time, first to last."""
        end = {"after_": since.isoformat()}
        return self._list({"state": {"type": {"any_": ENDED}}, "end_time": end}, "end_time")

    def progress(self, runs: Sequence[MatchRun]) -> dict[str, tuple[float, str]]:
        """Return percent and description of the progress of runs, by run id."""
        ids = [run.id for run in runs]
        wanted = {"type": {"any_": ["progress"]}, "flow_run_id": {"any_": ids}}
        found = self._all("artifacts", artifacts=wanted) if ids else []
        return {
            each["flow_run_id"]: (float(each["data"]), each["description"] or "")
            for each in sorted(found, key=lambda each: _time(each["updated"]))
            if each["data"] is not None
        }

    def _list(self, wanted: Mapping[str, Any], order: str) -> list[MatchRun]:
        """Return all runs that match a filter, by one of their times."""
        runs = self._all(
            "flow_runs",
            deployments={"name": {"any_": deployment_names(self.name)}},
            flows={"name": {"any_": ["match"]}},
            flow_runs=wanted,
        )
        return [self._run(run) for run in sorted(runs, key=lambda run: _time(run[order]))]

    def _all(self, kind: str, **filters: Mapping[str, Any]) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        for offset in page_offsets(found):
            page = {"sort": "ID_DESC", "limit": PAGE, "offset": offset}
            found += self._ask(f"/{kind}/filter", {**filters, **page})
        return list({each["id"]: each for each in found}.values())

    def _run(self, run: Mapping[str, Any]) -> MatchRun:
        due = run["next_scheduled_start_time"]
        return MatchRun(
            id=run["id"],
            name=run["name"],
            match_id=str(run["parameters"].get("match_id")),
            state=str(run["state_type"]),
            message=str((run["state"] or {}).get("message") or ""),
            link=f"{self.api.removesuffix('/api')}/runs/flow-run/{run['id']}",
            is_due=not due or _time(due) <= datetime.now(UTC) + SOON,
            ended_at=_time(run["end_time"]) if run["end_time"] else None,
        )

    def _ask(self, path: str, body: Mapping[str, Any] | None = None) -> Any:  # noqa: ANN401 - JSON
        headers = {"content-type": "application/json"}
        key = os.environ.get(CLOUD_LOGIN)
        if self.login:
            headers["authorization"] = authorization(self.login)
        elif key:
            headers["authorization"] = f"Bearer {key}"
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.api}{path}", data, headers)
        is_here = urlsplit(self.api).hostname in ("127.0.0.1", "localhost", "::1")
        proxies = urllib.request.ProxyHandler({} if is_here else None)
        opener = urllib.request.build_opener(proxies)
        for attempt in range(1, self.tries + 1):
            try:
                with opener.open(request, timeout=ANSWER_SECONDS) as answer:
                    return json.loads(answer.read())
            except urllib.error.HTTPError as error:
                problem = f"answers {error.code}"
                if error.code < 500:
                    break
            except (OSError, ValueError) as error:
                problem = f"does not answer: {getattr(error, 'reason', error)}"
            if attempt < self.tries:
                time.sleep(0.5 * attempt)
        raise UnreachablePrefectError(
            f"Prefect at {self.api} {problem}, and nothing was started. `worldpose serve --check` "
            "says what is wrong; try again."
        )


def run_name(what: str) -> str:
    """Return the name of a run that is created now: what it processes, and the time."""
    return f"{what}, {datetime.now().astimezone():%d %b %H:%M:%S}"


def artifact_key(match_id: str) -> str:
    """Return the match's name in keys of Prefect's artifacts."""
    return re.sub(r"[^a-z0-9]+", "-", match_id.lower()).strip("-")


def match_runs_of(url: str) -> MatchRuns | None:
    """Return the runs of a project that a service on this machine serves now; None without one.

    Args:
        url: folder or URL of the store.
    """
    state = served_state(url)
    serving = state.read_serving()
    if serving is None or "serve" not in serving.services:
        return None
    if not is_alive(serving.services["serve"].pid):
        return None
    pages = serving.services.get("pages")
    address = None if pages is None else pages.address
    return MatchRuns(serving.prefect, serving.name, _login(state, serving), address or "")


def _login(state: StateFolder, serving: Serving) -> str | None:
    given = os.environ.get(CLIENT_LOGIN)
    if given or not serving.owns_prefect:
        return given
    try:
        return state.prefect_login.read_text().strip()
    except OSError:
        return None  # the server's refusal then says so


@contextmanager
def alone_with(store: Store, match_id: str) -> Iterator[None]:
    """Wait until no other run of a deployment processes the match on this machine.

    The operating system ends the hold when the process ends.
    """
    state = served_state(store.url)
    with ExitStack() as stack:
        if state.folder.parent.is_dir():  # else this is a worker without a service's state
            lock = f"match-{match_id}"
            if not stack.enter_context(state.only_one(lock, wait=False)):
                LOG.info("%s: another run of it is at work; this one continues after it", match_id)
                stack.enter_context(state.only_one(lock, wait=True))
        while runs_at_work(store, match_id):  # by `worldpose run`, which takes no lock
            time.sleep(LOOK_SECONDS)
        yield


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text.replace("Z", "+00:00"))
