"""Status page: matches by stage, camera and clip, with times and metrics."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import quote

from fastapi import APIRouter
from fastapi.responses import FileResponse, HTMLResponse, Response
from jinja2 import Environment, FileSystemLoader, Template
from starlette.background import BackgroundTask

from data_contracts.operations import Arrival, MatchSummary, UnitSummary
from flows.method import METHOD
from flows.overview import PAGE, age, cost_of, is_late, units_of
from flows.review.descriptions import when
from flows.review.metric_words import in_short, reason_words
from flows.service.alerts import kept_alerts
from flows.service.layout import served_state
from flows.web.app_context import PageContext, say_cancelled
from flows.web.browser_words import in_browser

WORST_FIRST: Final = ("failed", "waiting", "blocked", "done")
REFRESH_SECONDS: Final = 15
UNSEEN_SECONDS: Final = 1
"""Until the page asks for the matches that the server has not read yet."""
BUDGET_SECONDS: Final = 0.1
"""Time that one request spends on reading matches."""
REST_SECONDS: Final = 0.5
"""Time spent on matches that were never read, after the page was sent."""
MAX_DETAILS: Final = 20
"""Matches whose cameras are on the page at once; of more matches, the one in the address."""
FILES: Final = Path(__file__).with_name("status")
"""The page, its style and its script."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the status page, and of its JSON."""
    router = APIRouter()
    overview = context.overview

    @router.get("/api/status")
    def status(page: int = 1) -> dict[str, Any]:
        found = overview.look(BUDGET_SECONDS)
        rows = _rows(context, found, min(max(page, 1), _pages(found)))
        return {
            "matches": [_as_json(each) for each in rows],
            "pages": _pages(found),
            "arrivals": [each.model_dump(mode="json") for each in _arrivals(context)],
            "alerts": _alerts(context),
        }

    @router.get("/status")
    def page(match: str = "", page: int = 1) -> HTMLResponse:
        serving = served_state(context.store.url).read_serving()
        dashboard = "" if serving is None else serving.prefect.removesuffix("/api")
        inbox = "" if serving is None else serving.inbox
        found = overview.look(BUDGET_SECONDS)
        names = [each.match_id for each in found]
        page = 1 + names.index(match) // PAGE if match in names else page
        page = min(max(page, 1), _pages(found))
        running = context.continuing.running()
        text = status_html(
            _rows(context, found, page),
            _arrivals(context),
            dashboard,
            inbox=inbox,
            opened=match,
            alerts=_alerts(context),
            counts=Counter(StatusRow(it, _running(it, running)).kind for it in found),
            place=(page, _pages(found)),
        )
        rest = BackgroundTask(overview.look, REST_SECONDS) if is_late(found) else None
        return HTMLResponse(text, background=rest)

    @router.get("/status/page.{kind}")
    def file(kind: Literal["css", "js"]) -> Response:
        return FileResponse(FILES / f"page.{kind}")

    return router


@dataclass(frozen=True)
class StatusRow:
    """A match on the page.

    `at_work` is the state of its run as the other pages have it, `prefect` the page of its latest
    run there; empty if unknown.
    """

    match: MatchSummary
    at_work: Mapping[str, Any] | None = None
    prefect: str = ""

    @property
    def words(self) -> str:
        """The state in words, as the page of the match has it."""
        if self.at_work is not None and self.at_work["state"] == "running":
            return "waiting for its turn" if self.at_work.get("waits") else "running"
        if self.match.problem:
            return "cannot be opened"
        return self.match.words or self.match.state

    @property
    def kind(self) -> str:
        """The state without its reason, to count matches by it."""
        words = re.split(r":| because", self.words)[0]
        return re.sub(r"^\d+ questions?", "with questions", words)

    @property
    def cost(self) -> str:
        """Core hours and bytes of the latest run."""
        return str(cost_of(self.match))

    @property
    def units(self) -> list[tuple[str, UnitSummary]]:
        """All units with their stage."""
        return list(units_of(self.match))


def _running(match: MatchSummary, running: Mapping[str, bool]) -> Mapping[str, Any] | None:
    waits = running.get(match.match_id)
    return None if waits is None else {"state": "running", "waits": waits}


def _pages(found: Sequence[MatchSummary]) -> int:
    return max(1, -(-len(found) // PAGE))


def _rows(context: PageContext, found: Sequence[MatchSummary], page: int) -> list[StatusRow]:
    """Return the matches of a page with their units, and their runs at work and at Prefect."""
    links = context.continuing.links()
    rows = []
    for match in found[PAGE * (page - 1) : PAGE * page]:
        name = match.match_id
        whole = match if match.is_unseen else context.overview.read(name)
        at_work = context.continuing.state(name)
        rows.append(StatusRow(say_cancelled(whole, at_work), at_work, links.get(name, "")))
    return rows


def status_html(
    rows: Sequence[StatusRow],
    arrivals: Iterable[Arrival],
    dashboard: str,
    *,
    inbox: str = "",
    opened: str = "",
    alerts: Sequence[Mapping[str, str]] = (),
    counts: Counter[str] | None = None,
    place: tuple[int, int] = (1, 1),
) -> str:
    """Render a page of matches; every name and message is escaped.

    Of more matches than `MAX_DETAILS`, only the `opened` one shows its cameras. `counts` are those
    of all matches by state, `place` is the number of the page and that of pages.
    """
    seen = {stage for row in rows for stage in row.match.stages}
    shown = [row.match for row in rows]
    is_unseen = any(each.is_unseen for each in shown)
    has_all = len(rows) <= MAX_DETAILS and place[1] == 1
    return TEMPLATE.render(
        rows=rows,
        stages=[stage.name for stage in METHOD if stage.name in seen],
        counts=(Counter(row.kind for row in rows) if counts is None else counts).most_common(),
        place=place,
        alerts=alerts[-PAGE:],
        further_alerts=max(0, len(alerts) - PAGE),
        arrivals=sorted(arrivals, key=lambda each: each.changed_at, reverse=True),
        begun={each.match_id for each in shown if each.latest is not None},
        detailed=[each for each in rows if has_all or each.match.match_id == opened],
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


TEMPLATE: Final = _read_page()


def _as_json(row: StatusRow) -> dict[str, Any]:
    match, latest = row.match, row.match.latest
    about = {"problem", "why", "stages"}
    return {
        "match": match.match_id,
        "state": match.state,
        "now": row.words,
        "run": latest and latest.run_id,
        "seconds": latest and latest.seconds,
        "at_work": row.at_work,
        "prefect": row.prefect,
        **asdict(cost_of(match)),
        **match.model_dump(mode="json", include=about),
    }


def _alerts(context: PageContext) -> list[dict[str, Any]]:
    kept = kept_alerts(served_state(context.store.url)).values()
    return [each for each in kept if each["alert"] != "digest"]


def _arrivals(context: PageContext) -> list[Arrival]:
    """Return what people look for: arrivals that are no match yet, and the last matches."""
    found = served_state(context.store.url).arrivals().values()
    last = sorted(found, key=lambda each: (each.state == "taken", -each.changed_at.timestamp()))
    return last[: max(PAGE, sum(each.state != "taken" for each in last))]
