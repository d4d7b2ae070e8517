"""Metrics of a project for Prometheus, computed from the store at each scrape."""

from __future__ import annotations

import hmac
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from threading import Lock, Thread
from typing import Any, Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from data_contracts.operations import MatchSummary
from flows.gates import GATES
from flows.overview import Overview, age
from flows.service.layout import StateFolder
from flows.service.plan import ServePlan
from flows.web.host_guard import HostGuard

MAX_SCRAPES: Final = 50
"""Open connections of scrapers."""
SIZE_SECONDS: Final = 300.0
"""Maximum age of the cached store size: it is a sum over all files."""
MOST_MATCHES: Final = 200
"""Matches with metrics of their own: those that ran last."""
LOOK_SECONDS: Final = 1.0
"""Time that one scrape spends on changed matches."""
STATES: Final = ("complete", "waiting", "partial", "failed", "at work", "not run", "unreadable")
UNIT_STATES: Final = ("done", "waiting", "failed", "blocked")
ARRIVAL_STATES: Final = ("arriving", "incomplete", "refused", "taken")


class ProjectMetrics(Collector):
    """Prometheus collector for a project."""

    def __init__(self, overview: Overview, state: StateFolder) -> None:
        self.store, self.state = overview.store, state
        self._overview = overview
        self._size: tuple[float, int | None] = (float("-inf"), None)
        self._sum = Thread()
        self._lock = Lock()

    def describe(self) -> list[Metric]:
        """Return nothing: the metric names come from `collect`."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all current metrics."""
        with self._lock:
            matches = self._overview.look(LOOK_SECONDS)
            size = self._store_size()
        ended = [each for match in matches for each in match.poses]
        ended_at = {it.match_id: it.latest.finished_at.timestamp() for it in matches if it.latest}
        last = sorted(matches, key=lambda it: ended_at.get(it.match_id, 0.0))[-MOST_MATCHES:]
        whole = [self._overview.read(each.match_id) for each in last if not each.is_unseen]
        states = Counter(match.state for match in matches)
        found = {(state,): states[state] for state in STATES}
        yield _gauge("matches", "Matches by state", ["state"], found)
        yield from _unit_metrics(matches, whole)
        yield from _quality(whole)
        total = sum(count for _, count in ended)
        yield CounterMetricFamily("worldpose_poses", "Bodies fitted by all runs", value=total)
        hour_ago = datetime.now(UTC) - timedelta(hours=1)
        last_hour = sum(count for at, count in ended if at >= hour_ago)
        about = "Bodies fitted by runs that ended within the last hour"
        yield _gauge("poses_last_hour", about, [], {(): last_hour})
        sizes = {} if size is None else {(): float(size)}
        yield _gauge("store_bytes", "Size of the project", [], sizes)
        folder = self.state.folder if "://" in self.store.url else self.store.url
        about = "Free on the disk of the project, or of the state of a project in object storage"
        yield _gauge("disk_free_bytes", about, [], {(): shutil.disk_usage(folder).free})
        arrived = Counter(each.state for each in self.state.arrivals().values())
        found = {(state,): arrived[state] for state in ARRIVAL_STATES}
        yield _gauge("arrivals", "Entries of the inbox by state", ["state"], found)
        held = json.loads(self.state.alerts.read_text()) if self.state.alerts.exists() else {}
        kinds = Counter((each["alert"],) for each in held.values())
        yield _gauge("alerts", "Alerts that hold, by what they are about", ["alert"], kinds)

    def _store_size(self) -> int | None:
        """Return the last known size; a scrape does not wait long for a sum over all files."""
        if not self._sum.is_alive() and time.monotonic() - self._size[0] > SIZE_SECONDS:
            self._sum = Thread(target=self._sum_files, daemon=True)
            self._sum.start()
        if self._sum.is_alive():
            self._sum.join(LOOK_SECONDS)
        return self._size[1]

    def _sum_files(self) -> None:
        tops = ("matches", "results", "runs", "reviews", "staging")
        size = sum(each.size for top in tops for each in self.store.blobs.entries(top))
        self._size = (time.monotonic(), size)


def exposition(metrics: ProjectMetrics) -> bytes:
    """Return the metrics in Prometheus text format."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(metrics)
    return generate_latest(registry)


def metrics_app(plan: ServePlan, metrics: ProjectMetrics, token: str) -> ASGIApp:
    """Create the application with `/metrics` and `/health`, for requests that name its server.

    `/metrics` requires the token, as `Authorization: Bearer TOKEN`.
    """
    expected = f"Bearer {token}".encode()

    def scrape(request: Request) -> Response:
        given = request.headers.get("authorization", "").encode("utf-8", "replace")
        if not hmac.compare_digest(given, expected):
            asked = {"www-authenticate": "Bearer"}
            return PlainTextResponse("expected Authorization: Bearer TOKEN\n", 401, asked)
        return Response(exposition(metrics), media_type=CONTENT_TYPE_LATEST)

    def say_up(request: Request) -> Response:
        return PlainTextResponse("up\n")

    routes = [Route("/metrics", scrape), Route("/health", say_up)]
    return HostGuard(Starlette(routes=routes), {plan.host, *plan.names})


def _gauge(name: str, about: str, labels: Sequence[str], values: Mapping[Any, float]) -> Metric:
    """Return a metric with a value for each combination of labels."""
    family = GaugeMetricFamily(f"worldpose_{name}", about, labels=labels)
    for labelled, value in values.items():
        family.add_metric(labelled, value)
    return family


def _unit_metrics(matches: list[MatchSummary], whole: list[MatchSummary]) -> Iterator[Metric]:
    """Yield the units of all matches by state, and times of the `whole` ones."""
    counts: Counter[tuple[str, str]] = Counter()
    seconds, waits, runs = {}, {}, {}
    for match in matches:
        for stage, states in match.progress.items():
            counts.update({(stage, state): number for state, number in states.items()})
    for match in whole:
        for stage, found in match.stages.items():
            seconds[match.match_id, stage] = sum(each.seconds or 0.0 for each in found)
        waits[match.match_id,] = max((age(each.since) for each in match.waiting), default=0.0)
        if match.latest is not None:
            runs[match.match_id,] = match.latest.seconds
    stages = sorted({stage for stage, _ in counts})
    units = {(stage, state): counts[stage, state] for stage in stages for state in UNIT_STATES}
    yield _gauge("units", "Units of latest runs by stage and state", ["stage", "state"], units)
    about = "Time of the units of a match's stage, summed"
    yield _gauge("stage_seconds", about, ["match", "stage"], seconds)
    about = "How long a match has waited for people, longest question"
    yield _gauge("gate_waiting_seconds", about, ["match"], waits)
    yield _gauge("run_seconds", "Time of the latest run", ["match"], runs)


def _quality(matches: list[MatchSummary]) -> Iterator[Metric]:
    """Yield the metrics that gates judge: the worst of a match's units, and the limit."""
    worst, limits = {}, {}
    for gate in GATES.values():
        for name, limit in gate.limits.items():
            limits[gate.stage, name] = limit
            for match in matches:
                units = match.stages.get(gate.stage, ())
                judged = [gate.judged(unit.figures) for unit in units if unit.figures]
                found = [figures[name] for figures in judged if name in figures]
                if found:
                    worst[match.match_id, gate.stage, name] = max(found)
    about = "Metric that a gate evaluates, of the match's worst unit"
    yield _gauge("quality", about, ["match", "stage", "figure"], worst)
    yield _gauge("quality_limit", "Largest that passes the gate", ["stage", "figure"], limits)
