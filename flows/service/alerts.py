"""What somebody has to be told of, and telling it once, by webhook and mail."""

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
from flows.service.layout import StateFolder
from flows.service.overview import MatchStatus, age
from flows.service.plan import ServePlan
from flows.service.senders import Sender
from worldpose.formats import whole_file

AlertKind = Literal["run_failed", "gate_waiting", "quality", "disk_low", "arrival_refused"]

FIRST_PAUSE: Final = 30.0
"""After a first failure of a sender; each further one doubles it [s]."""
LONGEST_PAUSE: Final = 3600.0
"""Between two tries of a sender that fails [s]."""

LOG = logging.getLogger("worldpose.operations")


@dataclass(frozen=True)
class Alert:
    """Something that somebody has to be told of.

    Attributes:
        key: the same as long as it is the same matter, which is told once.
        alert: what kind of matter it is.
        text: the matter, for people.
        link: where to look; empty where there is no such page.
        match_id: the match that it is about; empty where it is about none.
    """

    key: str
    alert: AlertKind
    text: str
    link: str = ""
    match_id: str = ""


@dataclass(frozen=True)
class FailedRun:
    """A run at the Prefect server that ended badly: its id, name, state and what it said."""

    id: str
    name: str
    state: str
    message: str


def alerts_now(
    plan: ServePlan,
    matches: Iterable[MatchStatus],
    arrivals: Iterable[Arrival],
    failed: Iterable[FailedRun],
) -> list[Alert]:
    """All that holds now, told before or not."""
    found = [
        Alert(
            f"run_failed/{run.id}",
            "run_failed",
            f"run {run.name} is {run.state}: {run.message}",
            f"{plan.dashboard}/runs/flow-run/{run.id}",
            run.name,
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
            text = f"{name}: {'; '.join(unit.objections)}"
            yield Alert(f"quality/{name}/{text}", "quality", text, link, match.match_id)


class AlertDispatcher:
    """Tells of each alert once, as long as it holds; what could not be told is told later.

    Each sender has its own pace: `hold` says what there is to be told, and never waits; `deliver`
    hands it to one sender, stops at the first failure, and tries again after a pause that doubles.

    Attributes:
        state: where it is kept what was told, so that a restart repeats nothing.
        senders: the ways to tell it; none tells the log alone.
        pause: after a first failure of a sender [s].
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
        """Hold and deliver to all senders in turn; gives what is new, where all ways took it."""
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
        """From now on these alerts are to be told, and no others."""
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
        """Hand what a sender has not taken yet to it, until it fails; not while it is paused."""
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
                # What the error says may hold the address, and that a secret.
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
                if kept is not None:  # it may be over meanwhile
                    took = {*kept["told_by"], name}
                    kept["told_by"] = [each.name for each in self.senders if each.name in took]
                    self._keep()

    def _keep(self) -> None:
        try:
            with whole_file(self.state.alerts) as draft:
                draft.write_text(json.dumps(self._told, indent=2) + "\n")
        except OSError as error:  # the disk may be what is to be told of
            LOG.warning("%s cannot be written: %s", self.state.alerts, error.strerror)


def _kept_alerts(state: StateFolder) -> dict[str, dict[str, Any]]:
    """What was told; nothing where the file is damaged, so that it is told once more."""
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
    """`text` is what chat services show of a webhook's JSON."""
    return {
        "alert": alert.alert,
        "match": alert.match_id,
        "text": alert.text,
        "link": alert.link,
    }
