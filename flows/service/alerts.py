"""Alerts for operators, each sent once to every channel."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, Final, Literal

from data_contracts.operations import Arrival
from flows.service.channels import Channel
from flows.service.layout import StateFolder
from flows.service.overview import MatchStatus, age
from flows.service.plan import ServePlan
from worldpose.formats.files import whole_file

AlertKind = Literal["run_failed", "gate_waiting", "quality", "disk_low", "arrival_refused"]

FIRST_PAUSE: Final = 30.0
"""After a channel's first failure; each further one doubles it [s]."""
LONGEST_PAUSE: Final = 3600.0
"""Between two attempts of a failing channel [s]."""

LOG = logging.getLogger("worldpose.operations")


@dataclass(frozen=True)
class Alert:
    """An alert for an operator.

    The key identifies the cause, of which one alert is sent. Link and match are empty without one.
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
    if match.latest is not None and match.latest.state in ("complete", "partial"):
        judged = match.latest.usability
        text = f"{match.match_id} is {judged.verdict}: {' '.join(judged.reservations)}"
        if judged.reservations:
            yield Alert(f"quality/{match.match_id}/{text}", "quality", text, link, match.match_id)
    for stage, unit in match.units:
        name = f"{match.match_id}/{stage}/{unit.unit}"
        hours = age(unit.waiting_since) / 3600.0
        if unit.state == "waiting" and hours >= plan.gate_hours:
            text = f"{name} has waited for a person for {hours:.1f} h: {unit.why}"
            yield Alert(f"gate_waiting/{name}/{run}", "gate_waiting", text, link, match.match_id)


class AlertDispatcher:
    """Sends each alert once while its cause lasts, and retries failed deliveries.

    `hold` sets the alerts to send and never blocks; `deliver` passes them to one channel. Each
    channel has its own pace, so that a slow one delays no other. The state keeps which alerts were
    sent, so that a restart repeats none. Without channels, alerts go to the log alone.
    """

    def __init__(self, state: StateFolder, channels: Sequence[Channel]) -> None:
        self.state, self.channels = state, tuple(channels)
        self._told = kept_alerts(state)
        self._lock = Lock()

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

    def deliver(self, channel: Channel, pause: float = 0.0) -> float:
        """Send a channel's outstanding alerts until it fails.

        `pause` is the one before this call, after a failure [s].

        Returns:
            The pause before the next call [s]; 0 = nothing failed.
        """
        while pending := self._pending(channel):
            key, content = pending[0]
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
                if key in self._told:  # its cause can have ended in between
                    self._told[key]["told_by"].append(channel.name)
                    self._keep()
        return 0.0

    def _pending(self, channel: Channel) -> list[tuple[str, dict[str, str]]]:
        with self._lock:
            return [
                (key, {name: text for name, text in kept.items() if name != "told_by"})
                for key, kept in self._told.items()
                if channel.name not in kept["told_by"]
            ]

    def _keep(self) -> None:
        try:
            with whole_file(self.state.alerts) as draft:
                draft.write_text(json.dumps(self._told, indent=2) + "\n")
        except OSError as error:  # the full disk can be the cause of the alert
            LOG.warning("%s cannot be written: %s", self.state.alerts, error.strerror)


def kept_alerts(state: StateFolder) -> dict[str, dict[str, Any]]:
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


def _content(alert: Alert) -> dict[str, str]:
    """Return the JSON content; chat services show `text`."""
    return {
        "alert": alert.alert,
        "match": alert.match_id,
        "text": alert.text,
        "link": alert.link,
    }
