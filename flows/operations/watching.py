"""What is looked at all the time while a project is served."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import threading
import time
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterName,
    FlowRunFilter,
    FlowRunFilterEndTime,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import State, StateType
from prefect.deployments import arun_deployment

from flows.operations.alerts import FailedRun, Teller, alerts_now
from flows.operations.arrivals import watch_once
from flows.operations.metrics import ProjectFigures, metrics_server
from flows.operations.overview import Overview
from flows.operations.plan import ServePlan
from flows.operations.recovery import begin_again, may_begin_again
from flows.operations.senders import senders_of
from flows.operations.service_secrets import METRICS_TOKEN
from worldpose.store import Store

INBOX_SECONDS: Final = 2.0
"""Between two looks at the inbox; longer where one look takes long."""
BUCKET_SECONDS: Final = 10.0
"""Between two looks at an inbox in object storage."""
ALERT_SECONDS: Final = 30.0
"""Between two looks for alerts and lost runs."""
FAILED_DAYS: Final = 7
"""A failed run is no alert any more after so long."""

LOG = logging.getLogger("worldpose.operations")


def watch(plan: ServePlan) -> None:
    """Watch until this process ends."""
    store = Store.create(plan.project)
    figures = ProjectFigures(store, plan.state_folder)
    server = metrics_server(plan, figures, os.environ[METRICS_TOKEN])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    asyncio.run(_watch(plan, store))


async def _watch(plan: ServePlan, store: Store) -> None:
    await asyncio.gather(_watch_bucket(plan), _watch_inbox(plan), _watch_runs(plan, store))


async def _watch_bucket(plan: ServePlan) -> None:
    if plan.bucket is None:
        return
    from flows.operations.bucket import BucketInbox  # late: object storage is an extra

    bucket = BucketInbox(plan.bucket, plan.inbox, plan.state_folder)
    while True:
        try:
            await asyncio.to_thread(bucket.fetch, time.monotonic(), plan.quiet_seconds)
        except Exception:
            LOG.exception("the bucket could not be looked at; it will be again")
        await asyncio.sleep(BUCKET_SECONDS)


async def _watch_inbox(plan: ServePlan) -> None:
    while True:
        began = time.monotonic()
        try:
            ready = await asyncio.to_thread(
                watch_once, plan.state_folder, plan.inbox, plan.quiet_seconds
            )
            if ready:
                await _ingest(plan, ready)
        except Exception:
            LOG.exception("the inbox could not be looked at; it will be again")
        took = time.monotonic() - began
        await asyncio.sleep(max(INBOX_SECONDS, 10.0 * took))


async def _ingest(plan: ServePlan, ready: list[str]) -> None:
    """Have arrivals taken in now; asked twice for the same ones, there is one run."""
    key = hashlib.sha256("\n".join(sorted(ready)).encode()).hexdigest()[:16]
    await arun_deployment(
        plan.ingest_deployment, timeout=0, as_subflow=False, idempotency_key=f"arrived-{key}"
    )


async def _watch_runs(plan: ServePlan, store: Store) -> None:
    overview = Overview(store)
    teller = Teller(plan.state_folder, senders_of(os.environ))
    while True:
        await asyncio.sleep(ALERT_SECONDS)
        try:
            await begin_again(plan)
            failed = await failed_runs(plan)
            matches = await asyncio.to_thread(overview.look)
            arrivals = plan.state_folder.arrivals().values()
            alerts = alerts_now(plan, matches, arrivals, failed)
            await asyncio.to_thread(teller.tell, alerts)
        except Exception:
            LOG.exception("alerts could not be looked for; they will be again")


async def failed_runs(plan: ServePlan) -> list[FailedRun]:
    """Runs of this project's deployments that ended badly and do not begin again."""
    bad = FlowRunFilterStateType(any_=[StateType.FAILED, StateType.CRASHED])
    since = FlowRunFilterEndTime(after_=datetime.now(UTC) - timedelta(days=FAILED_DAYS))
    async with get_client() as client:
        runs = await client.read_flow_runs(
            flow_run_filter=FlowRunFilter(state=FlowRunFilterState(type=bad), end_time=since),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[plan.name])),
        )
    return [
        FailedRun(str(run.id), run.name, str(run.state_name).lower(), _said(run.state))
        for run in runs
        if not may_begin_again(run)
    ]


def _said(state: State[Any] | None) -> str:
    return "" if state is None else str(state.message or "")
