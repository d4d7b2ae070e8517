"""Alerts for operators, each sent once to every channel."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from threading import Lock
from typing import Any, Final, Literal

from data_contracts.operations import Arrival, MatchSummary, QueuedRun
from data_contracts.run import RunRecord
from flows.overview import age
from flows.review.metric_words import all_reasons
from flows.service.channels import Channel
from flows.service.layout import StateFolder
from flows.service.plan import ServePlan
from worldpose.formats.files import whole_file
from worldpose.store.run_queue import ENDED, last_ended

AlertKind = Literal[
    "run_failed",
    "run_stalled",
    "run_late",
    "clock_stepped",
    "watch_stalled",
    "gate_waiting",
    "quality",
    "disk_low",
    "arrival_refused",
    "digest",
]
STANDSTILLS: Final = ("run_stalled", "run_late", "clock_stepped", "watch_stalled")
"""Alerts about what makes no progress."""
FAILED_DAYS: Final = 7
"""After so long, a failed run raises no alert."""
MAX_SINGLE: Final = 10
"""More new alerts than these are sent as one digest."""

FIRST_PAUSE: Final = 30.0
"""After a channel's first failure; each further one doubles it [s]."""
LONGEST_PAUSE: Final = 3600.0
"""Between two attempts of a failing channel [s]."""

LOG = logging.getLogger("worldpose.operations")


@dataclass(frozen=True)
class Alert:
    """An alert for an operator; link and match are empty without one.

    The key identifies the cause, of which one alert is sent.
    """

    key: str
    alert: AlertKind
    text: str
    link: str = ""
    match_id: str = ""


def alerts_now(
    plan: ServePlan,
    matches: Sequence[MatchSummary],
    arrivals: Iterable[Arrival],
    runs: Sequence[QueuedRun],
) -> list[Alert]:
    """Return all current alerts, sent before or not.

    `runs` are those of the queue, in the order of the requests.
    """
    latest = {each.match_id: each.latest for each in matches if each.latest is not None}
    found = [*_of_runs(plan, runs, latest)]
    for match in matches:
        found += _of_match(plan, match)
    found += [
        Alert(
            f"arrival_refused/{arrival.name}/{arrival.fingerprint}",
            "arrival_refused",
            f"{arrival.name} in the inbox is refused: {arrival.reason}",
            f"{plan.pages}/status",
        )
        for arrival in arrivals
        if arrival.state == "refused"
    ]
    free = shutil.disk_usage(plan.state if "://" in plan.project else plan.project).free
    if free < 1e9 * plan.disk_gb:
        text = f"{free / 1e9:.1f} GB are free for {plan.project}, fewer than {plan.disk_gb:g}"
        found.append(Alert("disk_low", "disk_low", text, f"{plan.pages}/status"))
    return found


def _of_runs(
    plan: ServePlan, runs: Sequence[QueuedRun], latest: Mapping[str, RunRecord]
) -> Iterator[Alert]:
    """Yield alerts of the last ended run of each match and flow, and of runs that were stalled."""
    for run in last_ended(runs):
        since = latest.get(run.match_id) if run.flow == "match" else None
        if since and since.state in ("complete", "waiting") and since.finished_at > run.changed_at:
            continue  # of `worldpose run`, which is not in the queue
        link = f"{plan.dashboard}/runs/flow-run/{run.flow_run}"
        if run.state == "failed" and age(run.changed_at) < 86400.0 * FAILED_DAYS:
            state = "partial" if ": partial" in run.message else "failed"
            text = f"run {run.name} is {state}: {run.message}"
            yield Alert(f"run_failed/{run.id}", "run_failed", text, link, run.match_id)
    for run in runs:
        if run.stalled and run.state not in ENDED:
            text = f"run {run.name} was ended, and restarts: {run.stalled}"
            key, link = f"run_stalled/{run.id}/{run.kills}", f"{plan.pages}/status"
            yield Alert(key, "run_stalled", text, link, run.match_id)


def _of_match(plan: ServePlan, match: MatchSummary) -> Iterator[Alert]:
    """Yield one alert about pending reviews of a match, and one about its quality."""
    link = f"{plan.pages}/#/match/{match.match_id}"
    waiting, newest = [], ""
    for asked in match.waiting:
        hours = age(asked.since) / 3600.0
        if hours >= plan.gate_hours:
            name, why = f"{match.match_id}/{asked.unit}", all_reasons(asked.reasons)
            waiting.append(f"{name} has waited for a person for {hours:.1f} h: {why}")
            newest = max(newest, str(asked.since)[:16])  # one for all of a run
    if waiting:
        text = waiting[0] + f"; and {len(waiting) - 1} more results" * (len(waiting) > 1)
        key = f"gate_waiting/{match.match_id}/{newest}"
        yield Alert(key, "gate_waiting", text, link, match.match_id)
    if match.latest is not None and match.latest.state in ("complete", "partial"):
        judged = match.latest.usability
        text = f"{match.match_id} is {judged.verdict}: {' '.join(judged.reservations)}"
        if judged.reservations:
            yield Alert(f"quality/{match.match_id}/{text}", "quality", text, link, match.match_id)


class AlertDispatcher:
    """Sends each alert once while its cause lasts, and retries failed deliveries.

    `hold` sets the alerts to send and never blocks; `deliver` passes them to one channel. Each
    channel has its own pace, so that a slow one delays no other. The state keeps which alerts were
    sent, so that a restart repeats none. Without channels, alerts go to the log alone.
    """

    def __init__(self, state: StateFolder, channels: Sequence[Channel]) -> None:
        self.state, self.channels = state, tuple(channels)
        self._told = kept_alerts(state)
        self._former = frozenset(self._told)
        self._held: dict[str, list[Alert]] = {}
        self._lock, self._writing = Lock(), Lock()

    def hold(self, alerts: Iterable[Alert], source: str = "", unread: Container[str] = ()) -> None:
        """Replace the alerts of a source, and add the day's digest of those that last.

        The former alerts of `unread` matches last: nothing says that they are over.
        """
        with self._lock:
            self._held[source] = list(alerts)
            today, before = f"{datetime.now(UTC):%Y-%m-%d}", self._told
            # Before the first look after a restart, nothing says that former alerts are over.
            former = frozenset[str]() if "" in self._held else self._former & before.keys()
            told = {
                key: each
                for key, each in before.items()
                if key in former or each.get("match") in unread
            }
            for alert in (each for held in self._held.values() for each in held):
                kept = before.get(alert.key) or {"since": today, "told_by": []}
                told[alert.key] = {**kept, **_content(alert)}
            lasting = [each["text"] for each in told.values() if each["since"] < today]
            if lasting:
                digest = Alert(f"digest/{today}", "digest", _digest(lasting, "last"))
                told[digest.key] = before.get(
                    digest.key, {**_content(digest), "since": today, "told_by": []}
                )
            self._told = told
            held_now = {alert.key for held in self._held.values() for alert in held}
        for key in sorted(held_now - before.keys()):  # after all else: the log's disk can be frozen
            LOG.warning("alert: %s", told[key]["text"])
        if told != before:
            self._keep()

    def deliver(self, channel: Channel, pause: float = 0.0) -> float:
        """Send a channel's outstanding alerts until it fails.

        `pause` is the one before this call, after a failure [s]. Return the pause before the next
        call [s]; 0 = nothing failed.
        """
        while pending := self._pending(channel):
            is_flood = len(pending) > MAX_SINGLE
            keys, content = pending[0]
            if is_flood:
                keys = [key for some, _ in pending for key in some]
                texts = [it["text"] for _, it in pending]
                content = {**_content(Alert("", "digest", _digest(texts, "are new")))}
            try:
                channel.send(content)
            except Exception as error:
                pause = min(2.0 * pause, LONGEST_PAUSE) or FIRST_PAUSE
                # The error message can contain the address, and that a secret.
                LOG.warning(
                    "%s did not take an alert: %s; again in %.0f s, with %s more",
                    *(channel.name, type(error).__name__, pause, len(pending) - 1),
                )
                return pause
            if pause:
                LOG.warning("%s takes alerts again", channel.name)
            pause = 0.0
            with self._lock:
                for key in self._told.keys() & keys:  # its cause can have ended in between
                    self._told[key]["told_by"].append(channel.name)
            self._keep()
        return 0.0

    def _pending(self, channel: Channel) -> list[tuple[list[str], dict[str, str]]]:
        """Return the keys and content of each outstanding message, one of each match."""
        found: dict[str, dict[str, dict[str, str]]] = {}
        with self._lock:
            for key, kept in self._told.items():
                if channel.name not in kept["told_by"]:
                    content = {name: kept[name] for name in CONTENT}
                    found.setdefault(kept["match"] or key, {})[key] = content
        merged = []
        for some in found.values():
            first, *others = some.values()
            text = "; ".join([first["text"], *(each["text"] for each in others)])
            merged.append(([*some], {**first, "text": text}))
        return merged

    def _keep(self) -> None:
        try:
            self.state.folder.stat()  # its disk may be away: then nothing is written in its place
            with self._writing, whole_file(self.state.alerts) as draft:
                draft.write_text(json.dumps(self._told, indent=2) + "\n")
        except OSError as error:  # the full disk can be the cause of the alert
            LOG.warning("%s cannot be written: %s", self.state.alerts, error.strerror)


def kept_alerts(state: StateFolder) -> dict[str, dict[str, Any]]:
    """Return the sent alerts; empty if the file is damaged, so that they are sent again."""
    try:
        kept = json.loads(state.alerts.read_text())
        return {
            key: {**each, "told_by": list(each["told_by"]), "since": str(each["since"])}
            for key, each in kept.items()
        }
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, AttributeError, TypeError, KeyError):
        LOG.warning("%s cannot be read; alerts that hold are told once more", state.alerts)
        return {}


def _digest(texts: Sequence[str], what: str) -> str:
    """Return the text of one message about several alerts."""
    more = f"\nand {len(texts) - MAX_SINGLE} more, on the status page"
    return "\n".join([f"{len(texts)} alerts {what}:", *texts[:MAX_SINGLE]]) + more * (
        len(texts) > MAX_SINGLE
    )


CONTENT: Final = ("alert", "match", "text", "link")


def _content(alert: Alert) -> dict[str, str]:
    """Return the JSON content; chat services show `text`."""
    return {"alert": alert.alert, "match": alert.match_id, "text": alert.text, "link": alert.link}
