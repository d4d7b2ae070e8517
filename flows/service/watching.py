"""Periodic checks while a project is served."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from threading import Thread
from typing import Final

from flows.orchestration.prefect_api import of_types, parse_time
from flows.service.alerts import AlertDispatcher, FailedRun, alerts_now
from flows.service.channels import Channel, channels_of
from flows.service.inbox import watch_once
from flows.service.match_runs import MatchRuns, run_name
from flows.service.metrics import MAX_SCRAPES, ProjectMetrics, metrics_app
from flows.service.overview import Overview
from flows.service.plan import ServePlan, deployment_names
from flows.service.recovery import ENDED_BADLY, PrefectRun, may_restart, restart_lost_runs
from flows.service.service_secrets import METRICS_TOKEN
from flows.web.http_server import serve_http
from worldpose.store.store import Store

INBOX_SECONDS: Final = 2.0
"""Between two scans of the inbox; longer if a scan takes long."""
BUCKET_SECONDS: Final = 10.0
"""Between two scans of an inbox in object storage."""
ALERT_SECONDS: Final = 30.0
"""Between two checks for alerts and lost runs."""
DELIVERY_SECONDS: Final = 2.0
"""Between two checks of a channel for outstanding alerts."""
TROUBLE_SECONDS: Final = 3600.0
"""Between two log lines about a lasting failure."""
TROUBLE_LENGTH: Final = 500
"""Maximum length of such a line."""
_PREFIX: Final = re.compile(r"^Flow run encountered an exception: (\w*IncompleteRunError: )?")
"""What Prefect writes before the reason of a failure."""
FAILED_DAYS: Final = 7
"""After so long, a failed run raises no alert."""
RESTART_PATIENCE: Final = timedelta(minutes=5)
"""A run that should restart and has not done so after this time raises an alert."""
LOOK_BACK: Final = timedelta(days=1)
"""Time before the last complete look at which runs may have ended unseen: clocks differ."""

LOG = logging.getLogger("worldpose.operations")


def watch(plan: ServePlan) -> None:
    """Watch, and serve metrics, until this process ends."""
    store, state = Store.create(plan.project), plan.state_folder
    dispatcher = AlertDispatcher(state, channels_of(os.environ, state.alert_settings))
    # Each at its own interval: none blocks another.
    _start("looking at the inbox", INBOX_SECONDS, lambda: _look_at_inbox(plan))
    if plan.bucket is not None:
        from flows.service.bucket import BucketInbox  # imported here: object storage is an extra

        bucket = BucketInbox(plan.bucket, plan.inbox, state)
        settle = plan.settle_seconds
        fetch = lambda: bucket.fetch(time.monotonic(), settle)  # noqa: E731
        _start("looking at the bucket", BUCKET_SECONDS, fetch)
    _start("looking for lost runs", ALERT_SECONDS, _restart_lost_runs(plan))
    _start("looking for alerts", ALERT_SECONDS, _hold_alerts(plan, store, dispatcher))
    for channel in dispatcher.channels:
        Thread(target=_deliver, args=(dispatcher, channel), daemon=True).start()
    app = metrics_app(plan, ProjectMetrics(store, state), os.environ[METRICS_TOKEN])
    serve_http(
        app,
        host=plan.host,
        port=plan.metrics_port,
        max_connections=MAX_SCRAPES,
        server_header=False,
        timeout_graceful_shutdown=2,
    )


class Trouble:
    """Failure log of a repeated operation: a lasting failure is logged once, then hourly."""

    def __init__(self, what: str) -> None:
        self.what = what
        self._said: str | None = None
        self._at = 0.0

    @contextmanager
    def log_failure(self) -> Iterator[None]:
        """Log a failure of the block on one line, and suppress it."""
        try:
            yield
        except Exception as error:
            said = " ".join(f"{type(error).__name__}: {error}".split())[:TROUBLE_LENGTH]
            now = time.monotonic()
            if said != self._said or now - self._at >= TROUBLE_SECONDS:
                LOG.warning("%s failed: %s; it is tried again", self.what, said)
                LOG.debug("%s", self.what, exc_info=error)
                self._said, self._at = said, now
        else:
            if self._said is not None:
                LOG.warning("%s works again", self.what)
                self._said = None


def _start(what: str, seconds: float, step: Callable[[], object]) -> None:
    """Repeat a step in a thread of its own until this process ends."""
    trouble = Trouble(what)

    def repeat() -> None:
        while True:
            with trouble.log_failure():
                step()
            time.sleep(seconds)

    Thread(target=repeat, name=what, daemon=True).start()


def _look_at_inbox(plan: ServePlan) -> None:
    """Start the intake of arrivals now; a second call for the same ones starts no second run."""
    began = time.monotonic()
    ready = watch_once(plan.state_folder, plan.inbox, plan.settle_seconds)
    if ready:
        key = hashlib.sha256("\n".join(sorted(ready)).encode()).hexdigest()[:16]
        MatchRuns.of_plan(plan).create_run(
            "ingest", name=run_name("arrivals"), idempotency_key=f"arrived-{key}"
        )
    time.sleep(9.0 * (time.monotonic() - began))  # a tenth of the time, however long a scan takes


def _restart_lost_runs(plan: ServePlan) -> Callable[[], None]:
    looked: datetime | None = None  # the first look takes all runs that ever failed

    def restart() -> None:
        nonlocal looked
        now = datetime.now(UTC)
        restart_lost_runs(plan, since=None if looked is None else min(looked, now) - LOOK_BACK)
        looked = now

    return restart


def _hold_alerts(plan: ServePlan, store: Store, dispatcher: AlertDispatcher) -> Callable[[], None]:
    overview, at_prefect = Overview(store), Trouble("asking Prefect for failed runs")
    failed: list[FailedRun] = []
    began = datetime.now(UTC)

    def hold() -> None:
        nonlocal failed
        with at_prefect.log_failure():
            failed = failed_runs(plan, began)
        arrivals = plan.state_folder.arrivals().values()
        dispatcher.hold(alerts_now(plan, overview.look(), arrivals, failed))

    return hold


def _deliver(dispatcher: AlertDispatcher, channel: Channel) -> None:
    pause = 0.0
    while True:
        time.sleep(pause or DELIVERY_SECONDS)
        pause = dispatcher.deliver(channel, pause)


def failed_runs(plan: ServePlan, began: datetime) -> list[FailedRun]:
    """Return failed runs of this project's deployments that do not restart, or have not in time.

    Runs that ended before the restarts `began` had to wait for them.
    """
    now = datetime.now(UTC)
    since = {"after_": (now - timedelta(days=FAILED_DAYS)).isoformat()}
    runs = MatchRuns.of_plan(plan).runs(
        deployment_names(plan.name), state=of_types(*ENDED_BADLY), end_time=since
    )

    def describe(run: PrefectRun) -> str | None:
        message = str((run["state"] or {}).get("message") or "")
        if not may_restart(run):
            return message
        ended = parse_time(run["end_time"]) if run["end_time"] else began
        is_overdue = max(ended, began) <= now - RESTART_PATIENCE
        return f"{message}; it was not restarted" if is_overdue else None

    return [
        FailedRun(
            run["id"],
            run["name"],
            "partial" if ": partial" in message else str(run["state_name"]).lower(),
            _PREFIX.sub("", message),
            str(run["parameters"].get("match_id") or ""),
        )
        for run in runs
        if (message := describe(run)) is not None
    ]
