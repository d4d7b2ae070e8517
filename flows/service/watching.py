"""Periodic checks while a project is served."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from threading import Thread
from typing import Final

from flows.overview import Overview, is_late
from flows.patience import LATE, clock_of_this_thread
from flows.service.alerts import Alert, AlertDispatcher, alerts_now
from flows.service.channels import Channel, channels_of
from flows.service.inbox import watch_once
from flows.service.match_runs import MatchRuns
from flows.service.metrics import MAX_SCRAPES, ProjectMetrics, metrics_app
from flows.service.plan import METRICS_TOKEN, ServePlan
from flows.service.recovery import Liveness, recover
from flows.web.http_server import serve_http
from worldpose.store.run_queue import ENDED, queue_of
from worldpose.store.store import Store

INBOX_SECONDS: Final = 2.0
"""Between two scans of the inbox; longer if a scan takes long."""
BUCKET_SECONDS: Final = 10.0
"""Between two scans of an inbox in object storage."""
ALERT_SECONDS: Final = 20.0
"""Between two checks for alerts."""
RECOVERY_SECONDS: Final = 10.0
"""Between two checks for lost runs, and for runs without progress."""
LOOK_SECONDS: Final = 2.0
"""Time of one look at matches for alerts, after which metrics have their turn."""
READING_SECONDS: Final = 60.0
"""Time of looks until alerts are sent, even if some matches are not read yet."""
DELIVERY_SECONDS: Final = 2.0
"""Between two checks of a channel for outstanding alerts."""
KEPT: Final = timedelta(days=1)
"""After so long, the queue keeps only the last ended run of each match and flow."""
TROUBLE_SECONDS: Final = 3600.0
"""Between two log lines about a lasting failure."""
TROUBLE_LENGTH: Final = 500
"""Maximum length of such a line."""
BUCKET: Final = "looking at the bucket"
"""This step may last as long as it takes to copy matches."""
STEPS: Final[dict[str, float]] = {}
"""Repeated steps that have begun and not ended, with their start [s]."""
CLOCKS: Final[dict[str, Callable[[], float]]] = {}
"""Processor time of the threads of steps [s]: it stands still while a disk does not answer."""
_MOVED: Final[dict[str, tuple[float, float]]] = {}
"""The last processor time of each step, and since when it is so [s]."""

LOG = logging.getLogger("worldpose.operations")


def watch(plan: ServePlan) -> None:
    """Watch, and serve metrics, until this process ends."""
    overview, state = Overview(Store.open(plan.project)), plan.state_folder
    dispatcher = AlertDispatcher(state, channels_of(os.environ, state.alert_settings))
    # Each at its own interval; a scan of the inbox takes a tenth of the time, however long it is.
    _start("looking at the inbox", INBOX_SECONDS, lambda: _look_at_inbox(plan), rest=9.0)
    if plan.bucket is not None:
        from flows.service.bucket import BucketInbox  # imported here: object storage is an extra

        bucket = BucketInbox(plan.bucket, plan.inbox, state)
        settle = plan.settle_seconds

        def fetch() -> None:
            Store.open(plan.project)  # as in `_look_at_inbox`
            bucket.fetch(time.monotonic(), settle)

        _start(BUCKET, BUCKET_SECONDS, fetch)
    liveness = Liveness(plan)
    unset = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # macOS has the second alone
    look = lambda: liveness.look(time.clock_gettime(unset), time.time())  # noqa: E731
    _start("recovering runs", RECOVERY_SECONDS, lambda: recover(plan))
    _start("looking for progress", RECOVERY_SECONDS, look)
    _start("forgetting runs", 3600.0, lambda: queue_of(plan.project).forget_ended(KEPT))
    _start("looking for alerts", ALERT_SECONDS, _hold_alerts(plan, overview, dispatcher, liveness))
    _start("watching the steps", ALERT_SECONDS, lambda: _watch_steps(plan, dispatcher))
    for channel in dispatcher.channels:
        Thread(target=_deliver, args=(dispatcher, channel), daemon=True).start()
    app = metrics_app(plan, ProjectMetrics(overview, state), os.environ[METRICS_TOKEN])
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


def _start(what: str, seconds: float, step: Callable[[], object], rest: float = 0.0) -> None:
    """Repeat a step in a thread of its own until this process ends.

    Between two steps is the larger of a time and of `rest` times the duration of the step.
    """
    trouble = Trouble(what)

    def repeat() -> None:
        if hasattr(time, "pthread_getcpuclockid"):  # not macOS
            CLOCKS[what] = clock_of_this_thread()
        while True:
            began = STEPS[what] = time.monotonic()
            with trouble.log_failure():
                step()
            STEPS.pop(what)
            time.sleep(max(seconds, rest * (time.monotonic() - began)))

    Thread(target=repeat, name=what, daemon=True).start()


def _look_at_inbox(plan: ServePlan) -> None:
    """Ask for the intake of arrivals now, unless one that has not ended may find them."""
    Store.open(plan.project)  # its disk may be away: then nothing is written in its place
    ready = watch_once(plan.state_folder, plan.inbox, plan.settle_seconds)
    runs = MatchRuns.of_plan(plan)
    if ready and all(run.state in ENDED for run in runs.queue.runs("queue/ingest")):
        runs.ask_for("ingest", {}, what="arrivals")


def _hold_alerts(
    plan: ServePlan, overview: Overview, dispatcher: AlertDispatcher, liveness: Liveness
) -> Callable[[], None]:
    queue = queue_of(plan.project)

    def hold() -> None:
        Store.open(plan.project)  # if its disk is away, no alert is over
        end = time.monotonic() + READING_SECONDS
        while is_late(matches := overview.look(LOOK_SECONDS)) and time.monotonic() < end:
            time.sleep(0.1)
        arrivals = plan.state_folder.arrivals().values()
        unread = {each.match_id for each in matches if each.is_unseen or each.is_silent}
        blind = unread - {each.match_id for each in matches if each.latest is not None}
        runs = [run for run in queue.runs() if run.state not in ENDED or run.match_id not in blind]
        found = alerts_now(plan, matches, arrivals, runs)
        dispatcher.hold([*found, *liveness.alerts], unread=unread)

    return hold


def _watch_steps(plan: ServePlan, dispatcher: AlertDispatcher) -> None:
    """Alert if a repeated step makes no progress: it needs no disk to notice that."""
    now, limit, late = time.monotonic(), 60.0 * plan.stall_minutes, []
    for what, began in list(STEPS.items()):
        spent = CLOCKS[what]() if what in CLOCKS else 0.0
        if spent != _MOVED.setdefault(what, (spent, 0.0))[0]:
            _MOVED[what] = spent, now
        if now - max(began, _MOVED[what][1]) > limit and what != BUCKET:
            late.append(what)
    for place, read in list(LATE.items()):
        if read.is_silent() and now - read.moved_at > limit:
            late.append(f"looking at {place}")
    text = f"{', '.join(late)}: no progress in {plan.stall_minutes:g} min; does a disk not answer?"
    alert = Alert("watch_stalled", "watch_stalled", text, f"{plan.pages}/status")
    dispatcher.hold([alert] if late else [], source="steps")


def _deliver(dispatcher: AlertDispatcher, channel: Channel) -> None:
    pause = 0.0
    while True:
        time.sleep(pause or DELIVERY_SECONDS)
        pause = dispatcher.deliver(channel, pause)
