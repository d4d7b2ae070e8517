"""What somebody has to be told of, and telling it once, by webhook and mail."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from data_contracts.operations import Arrival
from flows.operations.layout import StateFolder
from flows.operations.overview import MatchGlance, age
from flows.operations.plan import ServePlan
from flows.operations.senders import Sender
from worldpose.release import whole_file

AlertKind = Literal["run_failed", "gate_waiting", "quality", "disk_low", "arrival_refused"]

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
    matches: Iterable[MatchGlance],
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


def _of_match(plan: ServePlan, match: MatchGlance) -> Iterator[Alert]:
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


class Teller:
    """Tells of each alert once, as long as it holds; what could not be told is told later.

    Attributes:
        state: where it is kept what was told, so that a restart repeats nothing.
        senders: the ways to tell it; none tells the log alone.
    """

    def __init__(self, state: StateFolder, senders: Sequence[Sender]) -> None:
        self.state, self.senders = state, tuple(senders)
        kept = state.alerts.read_text() if state.alerts.exists() else "{}"
        self._told: dict[str, dict[str, Any]] = json.loads(kept)

    def tell(self, alerts: Iterable[Alert]) -> list[Alert]:
        """Tell what is new; gives that, where all ways took it."""
        before, told = self._told, {}
        new = []
        for alert in {each.key: each for each in alerts}.values():
            if alert.key not in before:
                LOG.warning("alert: %s", alert.text)
            took = before.get(alert.key, {}).get("told_by")
            now = self._send(alert, took or ())
            told[alert.key] = {**_content(alert), "told_by": now}
            if now != took and len(now) == len(self.senders):
                new.append(alert)
        if told != before:
            self._told = told
            with whole_file(self.state.alerts) as draft:
                draft.write_text(json.dumps(told, indent=2) + "\n")
        return new

    def _send(self, alert: Alert, took: Sequence[str]) -> list[str]:
        """The names of all senders that have taken it, now or before."""
        took = [sender.name for sender in self.senders if sender.name in took]
        for sender in self.senders:
            if sender.name in took:
                continue
            try:
                sender.send(_content(alert))
            except (OSError, ValueError) as error:
                # What the error says may hold the address, and that a secret.
                LOG.warning("%s did not take an alert: %s", sender.name, type(error).__name__)
            else:
                took.append(sender.name)
        return took


def _content(alert: Alert) -> Mapping[str, str]:
    """`text` is what chat services show of a webhook's JSON."""
    return {
        "alert": alert.alert,
        "match": alert.match_id,
        "text": alert.text,
        "link": alert.link,
    }
