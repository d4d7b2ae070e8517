"""Metrics of a project for Prometheus, computed from the store at each scrape."""

from __future__ import annotations

import hmac
import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock
from typing import Any, Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector

from flows.gates import GATES, Figures
from flows.service.layout import StateFolder
from flows.service.overview import MatchStatus, Overview, UnitSummary, age
from flows.service.plan import ServePlan
from flows.web.host_guard import LOOPBACK, host_name
from flows.web.http_server import Connections
from worldpose.store.store import Store

MAX_SCRAPES: Final = 50
"""Open connections of scrapers."""
SIZE_SECONDS: Final = 300.0
"""Maximum age of the cached store size: it is a sum over all files."""
STATES: Final = ("complete", "waiting", "partial", "failed", "at work", "not run", "unreadable")
UNIT_STATES: Final = ("done", "waiting", "failed", "blocked")
ARRIVAL_STATES: Final = ("arriving", "incomplete", "refused", "taken")


class ProjectMetrics(Collector):
    """Prometheus collector for a project.

    Attributes:
        store: the project.
        state: state of its arrivals and alerts.
    """

    def __init__(self, store: Store, state: StateFolder) -> None:
        self.store, self.state = store, state
        self._overview = Overview(store)
        self._size = (float("-inf"), 0)
        self._lock = Lock()

    def describe(self) -> list[Metric]:
        """Return nothing: the metric names come from `collect`."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all current metrics."""
        with self._lock:
            matches = self._overview.look()
            ended = self._overview.poses()
            size = self._store_size()
        yield _match_counts(matches)
        yield from _unit_metrics(matches)
        yield from _quality(matches)
        total = sum(count for _, count in ended)
        yield CounterMetricFamily("worldpose_poses", "Bodies fitted by all runs", value=total)
        hour_ago = datetime.now(UTC) - timedelta(hours=1)
        last_hour = sum(count for at, count in ended if at >= hour_ago)
        about = "Bodies fitted by runs that ended within the last hour"
        yield GaugeMetricFamily("worldpose_poses_last_hour", about, value=last_hour)
        yield GaugeMetricFamily("worldpose_store_bytes", "Size of the project", value=size)
        folder = self.state.folder if "://" in self.store.url else self.store.url
        free = shutil.disk_usage(folder).free
        about = "Free on the disk of the project, or of the state of a project in object storage"
        yield GaugeMetricFamily("worldpose_disk_free_bytes", about, value=free)
        arrived = Counter(each.state for each in self.state.arrivals().values())
        arrivals = GaugeMetricFamily(
            "worldpose_arrivals", "Entries of the inbox by state", labels=["state"]
        )
        for state in ARRIVAL_STATES:
            arrivals.add_metric([state], arrived[state])
        yield arrivals
        yield from _alerts(self.state)

    def _store_size(self) -> int:
        at, size = self._size
        if time.monotonic() - at > SIZE_SECONDS:
            tops = ("matches", "results", "runs", "reviews", "staging")
            size = sum(each.size for top in tops for each in self.store.blobs.entries(top))
            self._size = (time.monotonic(), size)
        return size


def exposition(metrics: ProjectMetrics) -> bytes:
    """Return the metrics in Prometheus text format."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(metrics)
    return generate_latest(registry)


def metrics_server(plan: ServePlan, metrics: ProjectMetrics, token: str) -> ThreadingHTTPServer:
    """Create a server of `/metrics` and `/health`, for requests that name it.

    Args:
        plan: its address and names.
        metrics: collector behind `/metrics`.
        token: required by `/metrics`, as `Authorization: Bearer TOKEN`.
    """
    names = LOOPBACK | {plan.host.lower(), *(name.lower() for name in plan.names)}
    expected = f"Bearer {token}".encode()

    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "worldpose", ""
        timeout = 10

        def do_GET(self) -> None:
            given = self.headers.get("authorization", "").encode("utf-8", "replace")
            if host_name(self.headers.get("host", "")) not in names:
                self._answer(421, b"this server has another name\n")
            elif self.path == "/metrics" and not hmac.compare_digest(given, expected):
                self._answer(401, b"expected Authorization: Bearer TOKEN\n")
            elif self.path == "/metrics":
                self._answer(200, exposition(metrics), CONTENT_TYPE_LATEST)
            elif self.path == "/health":
                self._answer(200, b"up\n")
            else:
                self._answer(404, b"no such page\n")

        def _answer(self, code: int, body: bytes, kind: str = "text/plain") -> None:
            self.send_response(code)
            self.send_header("content-type", kind)
            self.send_header("content-length", str(len(body)))
            self.send_header("x-content-type-options", "nosniff")
            if code == 401:
                self.send_header("www-authenticate", "Bearer")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Do not log scrapes."""

    return _MetricsServer((plan.host, plan.metrics_port), Handler)


class _MetricsServer(ThreadingHTTPServer):
    """One thread per connection; there are few, and slow ones are closed."""

    request_queue_size = 128

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.connections = Connections(MAX_SCRAPES)
        super().__init__(address, handler)

    def get_request(self) -> tuple[Any, Any]:
        connection, address = super().get_request()
        self.connections.admit(connection, address)
        return connection, address

    def service_actions(self) -> None:
        self.connections.sweep()


def _match_counts(matches: list[MatchStatus]) -> GaugeMetricFamily:
    found = Counter(match.state for match in matches)
    family = GaugeMetricFamily("worldpose_matches", "Matches by state", labels=["state"])
    for state in STATES:
        family.add_metric([state], found[state])
    return family


def _unit_metrics(matches: list[MatchStatus]) -> Iterator[Metric]:
    units = GaugeMetricFamily(
        "worldpose_units", "Units of latest runs by stage and state", labels=["stage", "state"]
    )
    seconds = GaugeMetricFamily(
        "worldpose_stage_seconds",
        "Time of the units of a match's stage, summed",
        labels=["match", "stage"],
    )
    waits = GaugeMetricFamily(
        "worldpose_gate_waiting_seconds",
        "How long a match has waited for people, longest question",
        labels=["match"],
    )
    run = GaugeMetricFamily("worldpose_run_seconds", "Time of the latest run", labels=["match"])
    counts: Counter[tuple[str, str]] = Counter()
    for match in matches:
        for stage, unit in match.units:
            counts[stage, unit.state] += 1
        for stage, found in match.stages.items():
            seconds.add_metric([match.match_id, stage], sum(each.seconds or 0.0 for each in found))
        ages = [age(unit.waiting_since) for _, unit in match.units if unit.state == "waiting"]
        waits.add_metric([match.match_id], max(ages, default=0.0))
        if match.latest is not None:
            run.add_metric([match.match_id], match.latest.seconds)
    for stage in sorted({stage for stage, _ in counts}):
        for state in UNIT_STATES:
            units.add_metric([stage, state], counts[stage, state])
    yield from (units, seconds, waits, run)


def _quality(matches: list[MatchStatus]) -> Iterator[Metric]:
    """Yield the metrics that gates judge: the worst of a match's units, and the limit."""
    worst = GaugeMetricFamily(
        "worldpose_quality",
        "Metric that a gate evaluates, of the match's worst unit",
        labels=["match", "stage", "figure"],
    )
    limits = GaugeMetricFamily(
        "worldpose_quality_limit", "Largest that passes the gate", labels=["stage", "figure"]
    )
    for gate in GATES:
        for name, limit in gate.limits:
            limits.add_metric([gate.stage, name], limit)
            for match in matches:
                found = _judged_values(match.stages.get(gate.stage, ()), gate.judged, name)
                if found:
                    worst.add_metric([match.match_id, gate.stage, name], max(found))
    yield from (worst, limits)


def _judged_values(
    units: tuple[UnitSummary, ...], judged: Callable[[Figures], Figures], name: str
) -> list[float]:
    figures = [judged(unit.figures) for unit in units if unit.figures]
    return [each[name] for each in figures if name in each]


def _alerts(state: StateFolder) -> Iterator[Metric]:
    held = json.loads(state.alerts.read_text()) if state.alerts.exists() else {}
    family = GaugeMetricFamily(
        "worldpose_alerts", "Alerts that hold, by what they are about", labels=["alert"]
    )
    for kind, count in sorted(Counter(each["alert"] for each in held.values()).items()):
        family.add_metric([kind], count)
    yield family
