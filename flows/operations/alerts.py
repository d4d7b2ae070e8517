"""What somebody has to be told of, and telling it once: a POST of JSON to a webhook."""

from __future__ import annotations

import json
import logging
import shutil
import urllib.request
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from data_contracts.operations import Arrival
from flows.operations.layout import StateFolder
from flows.operations.overview import MatchGlance, age
from flows.operations.plan import ServePlan
from worldpose.release import whole_file

AlertKind = Literal["run_failed", "gate_waiting", "quality", "disk_low", "arrival_refused"]
ANSWER_SECONDS: Final = 10.0
"""How long a webhook may take to answer."""

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
        address: of the webhook; None tells the log alone.
    """

    def __init__(self, state: StateFolder, address: str | None) -> None:
        self.state, self.address = state, address
        kept = state.alerts.read_text() if state.alerts.exists() else "{}"
        self._told: dict[str, dict[str, object]] = json.loads(kept)

    def tell(self, alerts: Iterable[Alert]) -> list[Alert]:
        """Tell what is new; gives that."""
        held = {alert.key: alert for alert in alerts}
        before = self._told
        told = {key: before[key] for key in held if key in before}
        new = [alert for key, alert in held.items() if not before.get(key, {}).get("told")]
        for alert in new:
            if alert.key not in before:
                LOG.warning("alert: %s", alert.text)
            told[alert.key] = {**_content(alert), "told": self._post(alert)}
        if told != before:
            self._told = told
            with whole_file(self.state.alerts) as draft:
                draft.write_text(json.dumps(told, indent=2) + "\n")
        return [alert for alert in new if told[alert.key]["told"]]

    def _post(self, alert: Alert) -> bool:
        """Whether the webhook took it; where there is none, the log has."""
        if self.address is None:
            return True
        body = json.dumps(_content(alert)).encode()
        headers = {"content-type": "application/json", "user-agent": "worldpose"}
        try:
            request = urllib.request.Request(self.address, data=body, headers=headers)
            with urllib.request.urlopen(request, timeout=ANSWER_SECONDS) as answer:
                return bool(200 <= answer.status < 300)
        except (OSError, ValueError) as error:
            # Its address may hold a secret: it is not said.
            LOG.warning("the webhook did not take an alert: %s", type(error).__name__)
            return False


def _content(alert: Alert) -> Mapping[str, object]:
    """`text` is what chat services show of a webhook's JSON."""
    return {
        "alert": alert.alert,
        "match": alert.match_id,
        "text": alert.text,
        "link": alert.link,
    }
