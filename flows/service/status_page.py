"""Status page: matches by stage, camera and clip, with times and metrics."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from fastapi import APIRouter
from fastapi.responses import FileResponse, HTMLResponse, Response
from jinja2 import Environment, FileSystemLoader, Template
from starlette.background import BackgroundTask

from data_contracts.operations import Arrival
from flows.method import METHOD
from flows.review.descriptions import when
from flows.review.metric_words import in_short, reason_words
from flows.service.alerts import kept_alerts
from flows.service.layout import served_state
from flows.service.overview import MatchStatus, Overview, UnitSummary, age
from flows.web.app_context import PageContext
from flows.web.browser_words import in_browser

WORST_FIRST: Final = ("failed", "waiting", "blocked", "done")
REFRESH_SECONDS: Final = 15
UNSEEN_SECONDS: Final = 1
"""Until the page asks for the matches that the server has not read yet."""
BUDGET_SECONDS: Final = 0.1
"""Time that one request spends on reading matches."""
REST_SECONDS: Final = 2.0
"""Time spent on matches that were never read, after the page was sent."""
MAX_DETAILS: Final = 20
"""Matches whose cameras are on the page at once; of more matches, the one in the address."""
UNIT_KEYS: Final = ["unit", "state", "seconds", "figures", "objections", "waiting_since", "why"]
"""What the page's JSON says of a unit."""
FILES: Final = Path(__file__).with_name("status")
"""The page, its style and its script."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the status page, and of its JSON."""
    router = APIRouter()
    overview = Overview(context.store, with_states=True)

    @router.get("/api/status")
    def status() -> dict[str, Any]:
        return {
            "matches": [_as_json(*each) for each in _with_runs(context, overview.look())],
            "arrivals": [each.model_dump(mode="json") for each in _arrivals(context)],
        }

    @router.get("/status")
    def page(match: str = "") -> HTMLResponse:
        serving = served_state(context.store.url).read_serving()
        dashboard = "" if serving is None else serving.prefect.removesuffix("/api")
        inbox = "" if serving is None else serving.inbox
        found = overview.look(BUDGET_SECONDS)
        rows = [StatusRow(*each) for each in _with_runs(context, found)]
        kept = kept_alerts(served_state(context.store.url)).values()
        alerts = [each for each in kept if each["alert"] != "digest"]
        text = status_html(
            rows, _arrivals(context), dashboard, inbox=inbox, opened=match, alerts=alerts
        )
        is_whole = not any(each.is_unseen for each in found)
        rest = None if is_whole else BackgroundTask(overview.look, REST_SECONDS)
        return HTMLResponse(text, background=rest)

    @router.get("/status/page.css")
    def style() -> Response:
        return FileResponse(FILES / "page.css")

    @router.get("/status/page.js")
    def script() -> Response:
        return FileResponse(FILES / "page.js")

    return router


@dataclass(frozen=True)
class StatusRow:
    """A match on the page.

    `at_work` is the state of its run as the other pages have it, `prefect` the page of its latest
    run there; empty if unknown.
    """

    match: MatchStatus
    at_work: Mapping[str, Any] | None = None
    prefect: str = ""

    @property
    def words(self) -> str:
        """The state in words, as the page of the match has it."""
        if self.at_work is not None and self.at_work["state"] == "running":
            return "running"
        if self.match.problem:
            return "cannot be opened"
        return self.match.state if self.match.now is None else self.match.now.words

    @property
    def kind(self) -> str:
        """The state without its reason, to count matches by it."""
        words = re.split(r":| because", self.words)[0]
        return re.sub(r"^\d+ questions?", "with questions", words)


def _with_runs(
    context: PageContext, found: Iterable[MatchStatus]
) -> list[tuple[MatchStatus, Mapping[str, Any] | None, str]]:
    """Return each match with the state of its run at work, and the run's page at Prefect."""
    links = context.continuing.links()
    ids = ((each, each.match_id) for each in found)
    return [(each, context.continuing.state(name), links.get(name, "")) for each, name in ids]


def status_html(
    rows: Sequence[StatusRow],
    arrivals: Iterable[Arrival],
    dashboard: str,
    *,
    inbox: str = "",
    opened: str = "",
    alerts: Iterable[Mapping[str, str]] = (),
) -> str:
    """Render the page; every name and message is escaped.

    Of more matches than `MAX_DETAILS`, only the `opened` one shows its cameras.
    """
    seen = {stage for row in rows for stage in row.match.stages}
    shown = [row.match for row in rows]
    is_unseen = any(each.is_unseen for each in shown)
    has_all = len(rows) <= MAX_DETAILS
    return PAGE.render(
        rows=rows,
        stages=[stage.name for stage in METHOD if stage.name in seen],
        counts=Counter(row.kind for row in rows).most_common(),
        alerts=alerts,
        arrivals=sorted(arrivals, key=lambda each: each.changed_at, reverse=True),
        begun={each.match_id for each in shown if each.latest is not None},
        detailed=[each for each in shown if has_all or each.match_id == opened],
        dashboard=dashboard,
        inbox=inbox,
        refresh=UNSEEN_SECONDS if is_unseen else REFRESH_SECONDS,
    )


def _summarize(units: Sequence[UnitSummary] | None) -> dict[str, Any] | None:
    """Return the worst unit state of a match's stage, units done, and times; None without units."""
    if not units:
        return None
    counts = Counter(unit.state for unit in units)
    others = [f"{counts[state]} {state}" for state in WORST_FIRST[:-1] if counts[state]]
    return {
        "worst": next(state for state in WORST_FIRST if counts[state]),
        "counts": [f"{counts['done']}/{len(units)}", *others],
        "waits": max((age(it.waiting_since) for it in units if it.state == "waiting"), default=0.0),
        "seconds": sum(unit.seconds or 0.0 for unit in units),
    }


def _describe_unit(unit: UnitSummary) -> str:
    said = [in_browser(unit.why), *map(reason_words, unit.objections), in_short(unit.figures)]
    return "; ".join(filter(None, said))


def _read_page() -> Template:
    files = Environment(loader=FileSystemLoader(FILES), autoescape=True, trim_blocks=True)
    files.filters |= {
        "described": _describe_unit,
        "in_browser": in_browser,
        "quote": lambda name: quote(name, safe=""),
        "summary": _summarize,
        "when": when,
    }
    return files.get_template("page.html")


PAGE: Final = _read_page()


def _as_json(match: MatchStatus, at_work: Mapping[str, Any] | None, prefect: str) -> dict[str, Any]:
    latest = match.latest
    return {
        "match": match.match_id,
        "state": match.state,
        "now": StatusRow(match, at_work).words,
        "why": "" if match.now is None else match.now.why,
        "problem": match.problem,
        "run": None if latest is None else latest.run_id,
        "seconds": None if latest is None else latest.seconds,
        "at_work": at_work,
        "prefect": prefect,
        "core_hours": match.cost.core_hours,
        "bytes": match.cost.bytes,
        "stages": {
            stage: [{name: getattr(unit, name) for name in UNIT_KEYS} for unit in units]
            for stage, units in match.stages.items()
        },
    }


def _arrivals(context: PageContext) -> list[Arrival]:
    return list(served_state(context.store.url).arrivals().values())
