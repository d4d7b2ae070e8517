"""Requests to Prefect's REST API, without importing Prefect, which takes seconds."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import Any, Final
from urllib.parse import quote, urlsplit

import httpx

from flows.orchestration.prefect_environment import CLOUD_LOGIN, LOOPBACK_NAMES, authorization
from worldpose.errors import WorldposeError

ANSWER_SECONDS: Final = 20.0
"""Timeout of Prefect's answer."""
PAGE: Final = 200
"""Items per answer: the maximum of Prefect's server."""


class UnreachablePrefectError(WorldposeError):
    """The Prefect server does not answer, or refuses."""

    problem = ""
    """What it answers, or why it does not."""
    status: int | None = None
    """Status code of its refusal."""


@dataclass(frozen=True)
class PrefectApi:
    """A Prefect server.

    Without a login it needs none; `tries` are the requests to a server that does not answer or
    whose database is busy.
    """

    api: str
    login: str | None = None
    tries: int = 4

    def ask(self, path: str, body: Any = None, *, method: str | None = None) -> Any:  # noqa: ANN401
        """Send a request, a POST if it has a body; UnreachablePrefectError without an answer."""
        headers = {}
        key = os.environ.get(CLOUD_LOGIN)
        if self.login:
            headers["authorization"] = authorization(self.login)
        elif key:
            headers["authorization"] = f"Bearer {key}"
        method = method or ("GET" if body is None else "POST")
        status = None
        for attempt in range(1, self.tries + 1):
            try:
                answer = _client(self.api).request(method, path, json=body, headers=headers)
                if answer.is_success:
                    return answer.json() if answer.content else None
                problem, status = f"answers {answer.status_code}", answer.status_code
                if status < 500:
                    problem += f" ({answer.text[:200]})" * (status == 422)
                    break
            except (httpx.HTTPError, ValueError) as error:
                problem = f"does not answer: {error or type(error).__name__}"
            if attempt < self.tries:
                time.sleep(0.5 * attempt)
        refusal = UnreachablePrefectError(
            f"Prefect at {self.api} {problem}, and nothing was started. `worldpose serve --check` "
            "says what is wrong; try again."
        )
        refusal.problem, refusal.status = problem, status
        raise refusal

    def find(self, path: str) -> Any:  # noqa: ANN401 - JSON
        """Return what is at a path; None if nothing is there."""
        try:
            return self.ask(path)
        except UnreachablePrefectError as error:
            if error.status == 404:
                return None
            raise

    def deployment(self, name: str) -> Any:  # noqa: ANN401 - JSON
        """Return the deployment of a full name, `FLOW/DEPLOYMENT`; None if there is none."""
        return self.find(f"/deployments/name/{quote(name)}")

    def list_all(self, kind: str, **filters: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return all items of a kind, such as `flow_runs`, that match Prefect's filters."""
        found: list[dict[str, Any]] = []
        is_full = True
        while is_full:
            # By id: with equal times, a page may repeat items and omit others.
            page = {"sort": "ID_DESC", "limit": PAGE, "offset": len(found)}
            found += (items := self.ask(f"/{kind}/filter", {**filters, **page}))
            is_full = len(items) == PAGE
        return list({each["id"]: each for each in found}.values())

    def runs(self, deployments: Sequence[str], **wanted: Any) -> list[dict[str, Any]]:  # noqa: ANN401
        """Return all runs of deployments, given without their flows, that match a filter."""
        named = {"name": {"any_": list(deployments)}}
        return self.list_all("flow_runs", deployments=named, flow_runs=wanted)

    def set_state(self, run_id: str, kind: str, message: str, name: str | None = None) -> None:
        """Set the state of a run, whatever it is now."""
        state = {"type": kind, "name": name, "message": message}
        self.ask(f"/flow_runs/{run_id}/set_state", {"state": state, "force": True})


@cache
def _client(api: str) -> httpx.Client:
    """Return the client of an address, which keeps its connections open."""
    is_here = urlsplit(api).hostname in LOOPBACK_NAMES
    return httpx.Client(base_url=api, timeout=ANSWER_SECONDS, trust_env=not is_here)


def of_types(*types: str) -> dict[str, Any]:
    """Return Prefect's filter of runs whose states have one of the types."""
    return {"type": {"any_": list(types)}}


def parse_time(text: str) -> datetime:
    """Return the time of a field of Prefect's answers."""
    return datetime.fromisoformat(text.replace("Z", "+00:00"))
