"""Periodic checks while a project is served."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun, State
from prefect.deployments import arun_deployment

from flows.service.alerts import AlertDispatcher, FailedRun, alerts_now
from flows.service.forms import offer_matches
from flows.service.inbox import watch_once
from flows.service.match_runs import run_name
from flows.service.metrics import ProjectMetrics, metrics_server
from flows.service.overview import Overview
from flows.service.plan import ServePlan
from flows.service.recovery import (
    ENDED_BADLY,
    may_restart,
    name_scheduled_runs,
    project_runs,
    restart_lost_runs,
)
from flows.service.senders import Sender, senders_of
from flows.service.service_secrets import METRICS_TOKEN
from worldpose.store.store import Store

INBOX_SECONDS: Final = 2.0
"""Between two scans of the inbox; longer if a scan takes long."""
BUCKET_SECONDS: Final = 10.0
"""Between two scans of an inbox in object storage."""
ALERT_SECONDS: Final = 30.0
"""Between two checks for alerts and lost runs."""
DELIVERY_SECONDS: Final = 2.0
"""Between two checks of a sender for outstanding alerts."""
TROUBLE_SECONDS: Final = 3600.0
"""Between two log lines about a lasting failure."""
TROUBLE_LENGTH: Final = 500
"""Maximum length of such a line."""
FAILED_DAYS: Final = 7
"""After so long, a failed run raises no alert."""
RESTART_PATIENCE: Final = timedelta(minutes=5)
"""A run that should restart and has not done so after this time raises an alert."""
LOOK_BACK: Final = timedelta(days=1)
"""Time before the last complete look at which runs may have ended unseen: clocks differ."""

LOG = logging.getLogger("worldpose.operations")


def watch(plan: ServePlan) -> None:
    """Watch until this process ends."""
    store = Store.create(plan.project)
    metrics = ProjectMetrics(store, plan.state_folder)
    server = metrics_server(plan, metrics, os.environ[METRICS_TOKEN])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    asyncio.run(_watch(plan, store))


async def _watch(plan: ServePlan, store: Store) -> None:
    dispatcher = AlertDispatcher(
        plan.state_folder, senders_of(os.environ, plan.state_folder.alert_settings)
    )
    await asyncio.gather(  # each at its own interval: none blocks another
        _watch_bucket(plan),
        _watch_inbox(plan),
        _watch_lost_runs(plan, store),
        _watch_alerts(plan, store, dispatcher),
        *(_deliver(dispatcher, sender) for sender in dispatcher.senders),
    )


class Trouble:
    """Failure log of a repeated operation: a lasting failure is logged once, then hourly.

    Attributes:
        what: name of the operation.
    """

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


async def _watch_bucket(plan: ServePlan) -> None:
    if plan.bucket is None:
        return
    from flows.service.bucket import BucketInbox  # imported here: object storage is an extra

    bucket = BucketInbox(plan.bucket, plan.inbox, plan.state_folder)
    trouble = Trouble("looking at the bucket")
    while True:
        with trouble.log_failure():
            await asyncio.to_thread(bucket.fetch, time.monotonic(), plan.settle_seconds)
        await asyncio.sleep(BUCKET_SECONDS)


async def _watch_inbox(plan: ServePlan) -> None:
    trouble = Trouble("looking at the inbox")
    while True:
        began = time.monotonic()
        with trouble.log_failure():
            ready = await asyncio.to_thread(
                watch_once, plan.state_folder, plan.inbox, plan.settle_seconds
            )
            if ready:
                await _ingest(plan, ready)
        took = time.monotonic() - began
        await asyncio.sleep(max(INBOX_SECONDS, 10.0 * took))


async def _ingest(plan: ServePlan, ready: list[str]) -> None:
    """Start the intake of arrivals now; a second call for the same ones starts no second run."""
    key = hashlib.sha256("\n".join(sorted(ready)).encode()).hexdigest()[:16]
    await arun_deployment(
        plan.ingest_deployment,
        timeout=0,
        as_subflow=False,
        idempotency_key=f"arrived-{key}",
        flow_run_name=run_name("arrivals"),
    )


async def _watch_lost_runs(plan: ServePlan, store: Store) -> None:
    trouble, naming = Trouble("looking for lost runs"), Trouble("naming runs and matches")
    looked: datetime | None = None  # the first look takes all runs that ever failed
    while True:
        with naming.log_failure():
            await name_scheduled_runs(plan)
            await offer_matches(plan, await asyncio.to_thread(store.matches))
        await asyncio.sleep(ALERT_SECONDS)
        with trouble.log_failure():
            now = datetime.now(UTC)
            since = None if looked is None else min(looked, now) - LOOK_BACK
            await restart_lost_runs(plan, since=since)
            looked = now


async def _watch_alerts(plan: ServePlan, store: Store, dispatcher: AlertDispatcher) -> None:
    overview = Overview(store)
    at_prefect = Trouble("asking Prefect for failed runs")
    trouble = Trouble("looking for alerts")
    failed: list[FailedRun] = []
    began = datetime.now(UTC)
    while True:
        await asyncio.sleep(ALERT_SECONDS)
        with at_prefect.log_failure():
            failed = await failed_runs(plan, began)
        with trouble.log_failure():
            matches = await asyncio.to_thread(overview.look)
            arrivals = plan.state_folder.arrivals().values()
            await asyncio.to_thread(dispatcher.hold, alerts_now(plan, matches, arrivals, failed))


async def _deliver(dispatcher: AlertDispatcher, sender: Sender) -> None:
    """Deliver alerts to one sender in its own thread, so that a slow sender delays no other."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=sender.name)
    while True:
        await asyncio.sleep(DELIVERY_SECONDS)
        await asyncio.get_running_loop().run_in_executor(pool, dispatcher.deliver, sender)


async def failed_runs(plan: ServePlan, began: datetime) -> list[FailedRun]:
    """Return failed runs of this project's deployments that do not restart, or have not in time.

    Args:
        plan: the served project.
        began: start of the restarts; runs that ended before had to wait for it.
    """
    now = datetime.now(UTC)
    async with get_client() as client:
        since = now - timedelta(days=FAILED_DAYS)
        runs = await project_runs(client, plan, ENDED_BADLY, ended_since=since)
    overdue = now - RESTART_PATIENCE

    def describe(run: FlowRun) -> str | None:
        message = _describe_state(run.state)
        if not may_restart(run):
            return message
        is_overdue = max(run.end_time or began, began) <= overdue
        return f"{message}; it was not restarted" if is_overdue else None

    return [
        FailedRun(
            str(run.id),
            run.name,
            str(run.state_name).lower(),
            message,
            str(run.parameters.get("match_id") or ""),
        )
        for run in runs
        if (message := describe(run)) is not None
    ]


def _describe_state(state: State[Any] | None) -> str:
    return "" if state is None else str(state.message or "")
