"""Status page: matches by stage, camera and clip, with times and metrics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from html import escape
from typing import Any, Final
from urllib.parse import quote

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, Response

from data_contracts.operations import Arrival
from flows.method import METHOD
from flows.progress import in_short
from flows.service.layout import served_state
from flows.service.overview import MatchStatus, Overview, UnitSummary, age
from flows.web.app_context import PageContext

WORST_FIRST: Final = ("failed", "waiting", "blocked", "done")
REFRESH_SECONDS: Final = 15
STYLE: Final = """
:root { color-scheme: light dark; --line: #d7ded8; --dim: #56625a; --paper: #fff; }
body { margin: 0; font: 15px/1.45 system-ui, sans-serif; background: #f4f6f4; color: #1d2420; }
main { padding: 0 1.2rem 3rem; }
header { display: flex; gap: 1.2rem; align-items: baseline; padding: .8rem 1.2rem; }
h1 { font-size: 1.2rem; margin: 0; }
h2 { font-size: 1rem; margin: 1.6rem 0 .5rem; }
a { color: #0b5c8f; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; background: var(--paper); }
th, td { border: 1px solid var(--line); padding: .3rem .55rem; text-align: left; }
th { font-weight: 600; font-size: .85rem; white-space: nowrap; }
td.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
small, .dim { color: var(--dim); font-size: .82rem; }
.done { border-left: 4px solid #009e73; }
.waiting { border-left: 4px solid #e69f00; }
.failed { border-left: 4px solid #d55e00; }
.blocked { border-left: 4px solid #999; }
.state { font-weight: 600; }
details { margin: .4rem 0; }
summary { cursor: pointer; }
@media (prefers-color-scheme: dark) {
  :root { --line: #37413f; --dim: #a2aea7; --paper: #1d2425; }
  body { background: #14191a; color: #e6ebe8; }
  a { color: #7cc4f5; }
}
"""
"""Colours that are distinct for colour-blind readers; each state is also given as text."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the status page, and of its JSON."""
    router = APIRouter()
    overview = Overview(context.store)

    @router.get("/api/status")
    def status() -> dict[str, Any]:
        return {
            "matches": [_as_json(match) for match in overview.look()],
            "arrivals": [each.model_dump(mode="json") for each in _arrivals(context)],
        }

    @router.get("/status")
    def page() -> HTMLResponse:
        serving = served_state(context.store.url).read_serving()
        dashboard = "" if serving is None else serving.prefect.removesuffix("/api")
        return HTMLResponse(status_html(overview.look(), _arrivals(context), dashboard))

    @router.get("/status/page.css")
    def style() -> Response:
        return Response(STYLE, media_type="text/css; charset=utf-8")

    return router


def status_html(matches: Sequence[MatchStatus], arrivals: Iterable[Arrival], dashboard: str) -> str:
    """Render the page; every name and message is escaped.

    Args:
        matches: all matches.
        arrivals: state of the inbox.
        dashboard: address of Prefect's dashboard; empty if unknown.
    """
    arrived = {each.match_id: each for each in arrivals if each.match_id}
    seen = {stage for match in matches for stage in match.stages}
    stages = [stage.name for stage in METHOD if stage.name in seen]
    counts = Counter(match.state for match in matches)
    said = ", ".join(f"{count} {state}" for state, count in counts.most_common())
    link = f'<a href="{escape(dashboard)}">Prefect dashboard</a>' if dashboard else ""
    rows = "".join(_row(match, stages, arrived, dashboard) for match in matches)
    heads = "".join(f"<th>{escape(name.replace('_', ' '))}</th>" for name in stages)
    table = (
        f'<div class="wide"><table><tr><th>match</th><th>latest run</th>{heads}</tr>{rows}</table>'
        "</div>"
        if matches
        else "<p>No match yet: put one into the inbox.</p>"
    )
    details = "".join(map(_details, matches))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>worldpose status</title>'
        f'<meta http-equiv="refresh" content="{REFRESH_SECONDS}">'
        '<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">'
        '<link rel="stylesheet" href="/status/page.css"></head><body>'
        f'<header><h1>worldpose status</h1><span class="dim">{escape(said)}</span>'
        f'<a href="/">Pending review</a>{link}</header>'
        f"<main>{table}{_inbox(arrivals)}{details}</main></body></html>"
    )


def _row(
    match: MatchStatus, stages: Sequence[str], arrived: Mapping[str, Arrival], dashboard: str
) -> str:
    name = escape(match.match_id)
    review = f'<a href="/#/match/{quote(match.match_id, safe="")}">{name}</a>'
    arrival = arrived.get(match.match_id)
    if dashboard and arrival is not None and arrival.flow_run:
        link = f"{dashboard}/runs/flow-run/{quote(arrival.flow_run, safe='')}"
        review += f' <small><a href="{escape(link)}">run</a></small>'
    state = f'<span class="state">{escape(match.state)}</span>'
    if match.latest is not None:
        run = match.latest
        state += f"<br><small>{escape(run.run_id)}, {_time(run.seconds)}, {run.gates}</small>"
    if match.problem:
        cells = f'<td class="failed" colspan="{max(1, len(stages))}">{escape(match.problem)}</td>'
    else:
        cells = "".join(_cell(match.stages.get(stage, ())) for stage in stages)
    return f"<tr><td>{review}</td><td>{state}</td>{cells}</tr>"


def _cell(units: Sequence[UnitSummary]) -> str:
    """Render one stage of a match: the worst unit state, units done, computation time."""
    if not units:
        return "<td></td>"
    counts = Counter(unit.state for unit in units)
    worst = next(state for state in WORST_FIRST if counts[state])
    seconds = sum(unit.seconds or 0.0 for unit in units)
    others = [f"{counts[state]} {state}" for state in WORST_FIRST[:-1] if counts[state]]
    words = "<br>".join([f"{counts['done']}/{len(units)} done", *others])
    since = [age(unit.waiting_since) for unit in units if unit.state == "waiting"]
    waits = f", for {_time(max(since))}" if since else ""
    took = f"<br><small>{_time(seconds)}</small>" if seconds else ""
    return f'<td class="{worst}">{words}{waits}{took}</td>'


def _details(match: MatchStatus) -> str:
    """Render a match's units, stage by stage."""
    rows = "".join(
        f"<tr><td>{escape(stage.replace('_', ' '))}</td><td>{escape(unit.unit)}</td>"
        f'<td class="{unit.state}">{unit.state}</td>'
        f'<td class="n">{"" if unit.seconds is None else _time(unit.seconds)}</td>'
        f"<td><small>{escape(_describe_unit(unit))}</small></td></tr>"
        for stage, unit in match.units
    )
    if not rows:
        return ""
    heads = "<tr><th>stage</th><th>camera or clip</th><th>state</th><th>time</th><th>metrics</th>"
    return (
        f"<details><summary>{escape(match.match_id)}, camera by camera</summary>"
        f'<div class="wide"><table>{heads}</tr>{rows}</table></div></details>'
    )


def _describe_unit(unit: UnitSummary) -> str:
    return "; ".join(filter(None, [unit.why, *unit.objections, in_short(unit.figures)]))


def _inbox(arrivals: Iterable[Arrival]) -> str:
    rows = "".join(
        f"<tr><td>{escape(each.name)}</td><td>{each.state}</td><td>{each.priority}</td>"
        f"<td>{_date(each.changed_at)}</td>"
        f"<td>{escape(each.match_id or '')}</td><td><small>{escape(each.reason)}</small></td></tr>"
        for each in sorted(arrivals, key=lambda each: each.changed_at, reverse=True)
    )
    if not rows:
        return ""
    heads = "".join(
        f"<th>{name}</th>" for name in ("arrival", "state", "priority", "since", "match", "why")
    )
    return f'<h2>Inbox</h2><div class="wide"><table><tr>{heads}</tr>{rows}</table></div>'


def _as_json(match: MatchStatus) -> dict[str, Any]:
    return {
        "match": match.match_id,
        "state": match.state,
        "problem": match.problem,
        "run": None if match.latest is None else match.latest.run_id,
        "seconds": None if match.latest is None else match.latest.seconds,
        "stages": {
            stage: [
                {
                    "unit": unit.unit,
                    "state": unit.state,
                    "seconds": unit.seconds,
                    "figures": unit.figures,
                    "objections": unit.objections,
                    "waiting_since": unit.waiting_since,
                    "why": unit.why,
                }
                for unit in units
            ]
            for stage, units in match.stages.items()
        },
    }


def _arrivals(context: PageContext) -> list[Arrival]:
    return list(served_state(context.store.url).arrivals().values())


def _time(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def _date(at: datetime) -> str:
    return f"{at:%Y-%m-%d %H:%M} UTC"
