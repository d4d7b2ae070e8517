"""Alerts for operators, each sent once, by webhook and mail."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, Final, Literal

from data_contracts.operations import Arrival
from flows.review.metric_words import all_reasons
from flows.service.layout import StateFolder
from flows.service.overview import MatchStatus, age
from flows.service.plan import ServePlan
from flows.service.senders import Sender
from worldpose.formats.files import whole_file

AlertKind = Literal["run_failed", "gate_waiting", "quality", "disk_low", "arrival_refused"]

FIRST_PAUSE: Final = 30.0
"""After a sender's first failure; each further one doubles it [s]."""
LONGEST_PAUSE: Final = 3600.0
"""Between two attempts of a failing sender [s]."""

LOG = logging.getLogger("worldpose.operations")


@dataclass(frozen=True)
class Alert:
    """An alert for an operator.

    Attributes:
        key: identifies the cause; each cause is sent once.
        alert: kind of the alert.
        text: message.
        link: page with details; empty if there is none.
        match_id: the match that it concerns; empty if none.
    """

    key: str
    alert: AlertKind
    text: str
    link: str = ""
    match_id: str = ""


@dataclass(frozen=True)
class FailedRun:
    """A failed run at the Prefect server: its id, name, state, message, and match if it has one."""

    id: str
    name: str
    state: str
    message: str
    match_id: str = ""


def alerts_now(
    plan: ServePlan,
    matches: Iterable[MatchStatus],
    arrivals: Iterable[Arrival],
    failed: Iterable[FailedRun],
) -> list[Alert]:
    """Return all current alerts, sent before or not."""
    found = [
        Alert(
            f"run_failed/{run.id}",
            "run_failed",
            f"run {run.name} is {run.state}: {run.message}",
            f"{plan.dashboard}/runs/flow-run/{run.id}",
            run.match_id,
        )
        for run in failed
    ]
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


def _of_match(plan: ServePlan, match: MatchStatus) -> Iterator[Alert]:
    run = "" if match.latest is None else match.latest.run_id
    link = f"{plan.pages}/#/match/{match.match_id}"
    for stage, unit in match.units:
        name = f"{match.match_id}/{stage}/{unit.unit}"
        hours = age(unit.waiting_since) / 3600.0
        if unit.state == "waiting" and hours >= plan.gate_hours:
            text = f"{name} has waited for a person for {hours:.1f} h: {unit.why}"
            yield Alert(f"gate_waiting/{name}/{run}", "gate_waiting", text, link, match.match_id)
        if unit.objections:
            text = f"{name}: {all_reasons(unit.objections)}"
            yield Alert(f"quality/{name}/{text}", "quality", text, link, match.match_id)


class AlertDispatcher:
    """Sends each alert once while its cause lasts, and retries failed deliveries.

    Each sender has its own pace: `hold` sets the alerts to send and never blocks; `deliver` passes
    them to one sender, stops at the first failure, and retries after a pause that doubles.

    Attributes:
        state: keeps which alerts were sent, so that a restart repeats none.
        senders: the channels; without any, alerts go to the log alone.
        pause: after a sender's first failure [s].
    """

    def __init__(
        self, state: StateFolder, senders: Sequence[Sender], pause: float = FIRST_PAUSE
    ) -> None:
        self.state, self.senders, self.pause = state, tuple(senders), pause
        self._told = _kept_alerts(state)
        self._lock = Lock()
        self._pauses: dict[str, float] = {}
        self._due: dict[str, float] = {}

    def tell(self, alerts: Iterable[Alert]) -> list[Alert]:
        """Hold and deliver to all senders in turn; return the new alerts that all accepted."""
        alerts = list({each.key: each for each in alerts}.values())
        before = {key: kept.get("told_by") for key, kept in self._told.items()}
        self.hold(alerts)
        for sender in self.senders:
            self.deliver(sender)
        names = [sender.name for sender in self.senders]
        told = {key: kept["told_by"] for key, kept in self._told.items()}
        return [
            each
            for each in alerts
            if told[each.key] != before.get(each.key) and set(told[each.key]) == set(names)
        ]

    def hold(self, alerts: Iterable[Alert]) -> None:
        """Replace the alerts to send."""
        with self._lock:
            before, told = self._told, {}
            for alert in alerts:
                if alert.key not in before:
                    LOG.warning("alert: %s", alert.text)
                took = before.get(alert.key, {}).get("told_by", [])
                told[alert.key] = {**_content(alert), "told_by": list(took)}
            self._told = told
            if told != before:
                self._keep()

    def deliver(self, sender: Sender) -> None:
        """Send a sender's outstanding alerts until it fails; does nothing during its pause."""
        name = sender.name
        while time.monotonic() >= self._due.get(name, float("-inf")):
            with self._lock:
                pending = [key for key, kept in self._told.items() if name not in kept["told_by"]]
                if not pending:
                    return
                content = {at: it for at, it in self._told[pending[0]].items() if at != "told_by"}
            try:
                sender.send(content)
            except Exception as error:
                pause = min(2.0 * self._pauses.get(name, 0.5 * self.pause), LONGEST_PAUSE)
                self._pauses[name], self._due[name] = pause, time.monotonic() + pause
                # The error message can contain the address, and that a secret.
                kind = type(error).__name__
                LOG.warning(
                    "%s did not take an alert: %s; again in %.0f s, with %s more",
                    *(name, kind, pause, len(pending) - 1),
                )
                return
            if self._pauses.pop(name, None) is not None:
                LOG.warning("%s takes alerts again", name)
            with self._lock:
                kept = self._told.get(pending[0])
                if kept is not None:  # its cause can have ended in between
                    took = {*kept["told_by"], name}
                    kept["told_by"] = [each.name for each in self.senders if each.name in took]
                    self._keep()

    def _keep(self) -> None:
        try:
            with whole_file(self.state.alerts) as draft:
                draft.write_text(json.dumps(self._told, indent=2) + "\n")
        except OSError as error:  # the full disk can be the cause of the alert
            LOG.warning("%s cannot be written: %s", self.state.alerts, error.strerror)


def _kept_alerts(state: StateFolder) -> dict[str, dict[str, Any]]:
    """Return the sent alerts; empty if the file is damaged, so that they are sent again."""
    try:
        kept = json.loads(state.alerts.read_text())
        return {
            key: {**each, "told_by": list(each.get("told_by", []))} for key, each in kept.items()
        }
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, AttributeError, TypeError):
        LOG.warning("%s cannot be read; alerts that hold are told once more", state.alerts)
        return {}


def _content(alert: Alert) -> Mapping[str, str]:
    """Return the JSON content; chat services show `text`."""
    return {
        "alert": alert.alert,
        "match": alert.match_id,
        "text": alert.text,
        "link": alert.link,
    }
