"""Status page: matches by stage, camera and clip, with times and metrics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final
from urllib.parse import quote

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, Response
from starlette.background import BackgroundTask

from data_contracts.operations import Arrival
from flows.method import METHOD
from flows.review.descriptions import when
from flows.review.metric_words import in_short, reason_words
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
STYLE: Final = """
:root {
  color-scheme: light dark;
  --ground: #f4f6f5; --panel: #ffffff; --ink: #1d2423; --soft: #5a6764; --line: #d6ddda;
  --accent: #0b5c8f; --done: #0072b2; --waiting: #e69f00; --failed: #d55e00; --blocked: #8a9692;
  --focus: #e69f00;
  font: 15px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ground: #14191a; --panel: #1d2425; --ink: #e6ebe9; --soft: #a2aeab; --line: #37413f;
    --accent: #56b4e9; --done: #56b4e9; --failed: #ffa04d;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); }
body > header {
  display: flex; justify-content: space-between; align-items: center; gap: 1rem;
  padding: .5rem 1rem; background: var(--panel); border-bottom: 1px solid var(--line);
  min-height: 2.9rem;
}
nav, .right { display: flex; align-items: center; gap: .6rem; min-width: 0; }
nav a { text-decoration: none; color: inherit; font-weight: 650; }
nav a:hover { text-decoration: underline; }
main { padding: 1.2rem 1.2rem 3rem; }
h1 { font-size: 1.25rem; margin: 0 0 .8rem; font-weight: 650; }
h2 { font-size: 1rem; margin: 1.6rem 0 .5rem; font-weight: 650; }
a { color: var(--accent); }
:focus-visible { outline: 3px solid var(--focus); outline-offset: 1px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; }
th, td {
  text-align: left; padding: .3rem .45rem .3rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: anywhere;
}
th { color: var(--soft); font-weight: 600; font-size: .86rem; vertical-align: bottom; }
th.stage { writing-mode: vertical-rl; transform: rotate(180deg); padding: .3rem 0 .2rem; }
th.stage { white-space: nowrap; overflow-wrap: normal; border: 0; font-size: .8rem; }
th.stage { line-height: 3.2rem; }
td.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.cell { width: 3.2rem; padding: .3rem .1rem; font-size: .78rem; line-height: 1.25; }
td.match, td.run { min-width: 13rem; line-height: 1.3; }
small, .soft { color: var(--soft); font-size: .82rem; }
.cell > span, .unit { display: block; padding-left: .3rem; border-left: 4px solid var(--line); }
.cell > span { overflow-wrap: normal; white-space: nowrap; }
.done { border-color: var(--done) !important; }
.waiting { border-color: var(--waiting) !important; }
.failed { border-color: var(--failed) !important; }
.blocked { border-color: var(--blocked) !important; }
.state { font-weight: 600; }
progress { width: 100%; accent-color: var(--accent); }
button {
  font: inherit; color: var(--ink); background: var(--panel); border: 1px solid var(--line);
  border-radius: 6px; padding: .25rem .7rem; cursor: pointer;
}
button:hover { border-color: var(--accent); }
kbd { font: .82em ui-monospace, "DejaVu Sans Mono", monospace; white-space: nowrap; }
kbd { border: 1px solid var(--line); border-radius: 4px; padding: 0 .35em; }
dialog { background: var(--panel); color: var(--ink); border: 1px solid var(--line); }
dialog { border-radius: 10px; padding: 1.2rem 1.4rem; max-width: min(44rem, 92vw); }
dialog h2:first-child { margin-top: 0; }
dialog td:first-child { white-space: nowrap; padding-right: 1rem; }
dialog form { margin-top: 1rem; }
#who { color: var(--soft); font-size: .86rem; }
details { margin: .4rem 0; }
summary { cursor: pointer; }
@media (max-width: 48rem) {
  main, body > header { padding-inline: .7rem; flex-wrap: wrap; }
  table, tbody { display: block; }
  #who, #ask { display: none; }
  dialog table { display: table; }
  dialog tbody { display: table-row-group; }
  dialog tr { display: table-row; }
  main tr { display: flex; flex-wrap: wrap; margin-bottom: .6rem; background: var(--panel); }
  main tr { border: 1px solid var(--line); border-radius: 8px; padding: .4rem .6rem; }
  main tr:has(th), td:empty { display: none; }
  main td { border: 0; flex: 1 1 8rem; }
  main td.cell { flex: 0 0 50%; font-size: .86rem; }
  td[data-of]::before { content: attr(data-of); display: block; color: var(--soft); }
}
"""
"""Colours and sizes of the other pages; each state is also given as text."""
SCRIPT: Final = """"use strict";
const help = document.getElementById("help");
const who = document.getElementById("who");
const leave = document.getElementById("leave");
let secret = "";
fetch("/api/session").then(async (answer) => {
  if (!answer.ok) return location.assign("/login");
  const session = await answer.json();
  secret = session.form_secret;
  who.textContent = `${session.who}, ${session.role}`;
  leave.hidden = false;
}).catch(() => {});
leave.addEventListener("click", async () => {
  const headers = { "content-type": "application/json", "x-form-secret": secret };
  const answer = await fetch("/api/logout", { method: "POST", headers, body: "{}" });
  location.assign(answer.ok ? (await answer.json()).next : "/login");
});
document.getElementById("ask").addEventListener("click", () => help.showModal());
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === "?") help.open ? help.close() : help.showModal();
  else if (help.open) return;
  else if (event.key === "q" || event.key === "Q") location.assign("/");
  else if (event.key === "r" || event.key === "R") location.reload();
});
setInterval(async () => {
  if (help.open) return;
  const isUp = await fetch("/api/health").then((answer) => answer.ok, () => false);
  if (isUp && !help.open) location.reload();
}, 1000 * Number(document.body.dataset.refresh));
"""
"""Log-out and keys; the page loads again while the service answers and its help is closed."""
HELP: Final = """<dialog id="help" aria-label="Help"><h2>Keys</h2><table>
<tr><td><kbd>?</kbd></td><td>this help</td></tr>
<tr><td><kbd>Q</kbd></td><td>matches with pending reviews</td></tr>
<tr><td><kbd>R</kbd></td><td>load the page now; it loads by itself every 15 seconds</td></tr>
<tr><td><kbd>Esc</kbd></td><td>close the help</td></tr></table>
<h2>States</h2><table>
<tr><td>done</td><td>computed; 3/4 means three of four results of the stage</td></tr>
<tr><td>waiting</td><td>a person has to approve the result before later stages use it</td></tr>
<tr><td>failed</td><td>it ended with an error, which stands below the table</td></tr>
<tr><td>blocked</td><td>an earlier result is missing: failed, or not yet approved</td></tr></table>
<form method="dialog"><button>Close</button></form></dialog>"""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the status page, and of its JSON."""
    router = APIRouter()
    overview = Overview(context.store)

    @router.get("/api/status")
    def status() -> dict[str, Any]:
        return {
            "matches": [_as_json(match, *_run_of(context, match)) for match in overview.look()],
            "arrivals": [each.model_dump(mode="json") for each in _arrivals(context)],
        }

    @router.get("/status")
    def page(match: str = "") -> HTMLResponse:
        serving = served_state(context.store.url).read_serving()
        dashboard = "" if serving is None else serving.prefect.removesuffix("/api")
        inbox = "" if serving is None else serving.inbox
        found = overview.look(BUDGET_SECONDS)
        rows = [StatusRow(each, *_run_of(context, each)) for each in found]
        text = status_html(rows, _arrivals(context), dashboard, inbox=inbox, opened=match)
        is_whole = not any(each.is_unseen for each in found)
        rest = None if is_whole else BackgroundTask(overview.look, REST_SECONDS)
        return HTMLResponse(text, background=rest)

    @router.get("/status/page.css")
    def style() -> Response:
        return Response(STYLE, media_type="text/css; charset=utf-8")

    @router.get("/status/page.js")
    def script() -> Response:
        return Response(SCRIPT, media_type="text/javascript; charset=utf-8")

    return router


@dataclass(frozen=True)
class StatusRow:
    """A match on the page.

    Attributes:
        match: its status.
        at_work: state of its run as the other pages have it; None if none is at work.
        prefect: page of its latest run at Prefect; empty if unknown.
    """

    match: MatchStatus
    at_work: Mapping[str, Any] | None = None
    prefect: str = ""


def _run_of(context: PageContext, match: MatchStatus) -> tuple[Mapping[str, Any] | None, str]:
    runs = context.continuing
    return runs.state(match.match_id), runs.links().get(match.match_id, "")


def status_html(
    rows: Sequence[StatusRow],
    arrivals: Iterable[Arrival],
    dashboard: str,
    *,
    inbox: str = "",
    opened: str = "",
) -> str:
    """Render the page; every name and message is escaped.

    Args:
        rows: all matches.
        arrivals: state of the inbox.
        dashboard: address of Prefect's dashboard; empty if unknown.
        inbox: path of the inbox; empty if unknown.
        opened: id of the match whose cameras are shown, if there are more than `MAX_DETAILS`.
    """
    seen = {stage for row in rows for stage in row.match.stages}
    stages = [stage.name for stage in METHOD if stage.name in seen]
    counts = Counter(row.match.state for row in rows)
    said = ", ".join(f"{count} {state}" for state, count in counts.most_common())
    link = f'<a href="{escape(dashboard)}">Prefect</a>' if dashboard else ""
    lines = "".join(_row(row, stages) for row in rows)
    heads = "".join(f'<th class="stage">{escape(name.replace("_", " "))}</th>' for name in stages)
    table = (
        f'<div class="wide"><table><tr><th>match</th><th>latest run</th>{heads}</tr>{lines}</table>'
        "</div>"
        if rows
        else f"<p>No match yet. {_describe_beginning(inbox)}</p>"
    )
    has_all, shown = len(rows) <= MAX_DETAILS, [row.match for row in rows]
    details = "".join(_details(each) for each in shown if has_all or each.match_id == opened)
    begun = {each.match_id for each in shown if each.latest is not None}
    refresh = UNSEEN_SECONDS if any(each.is_unseen for each in shown) else REFRESH_SECONDS
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>worldpose status</title>'
        f'<noscript><meta http-equiv="refresh" content="{refresh}"></noscript>'
        '<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">'
        '<link rel="stylesheet" href="/status/page.css">'
        '<script defer src="/status/page.js"></script>'
        f'</head><body data-refresh="{refresh}">'
        '<header><nav aria-label="Where you are"><a href="/">worldpose review</a>'
        '<span>&rsaquo;</span><span aria-current="page">Status</span></nav>'
        f'<div class="right"><a href="/">Matches and reviews</a>{link}'
        '<button id="ask" title="Keys and states of this page">Help <kbd>?</kbd></button>'
        '<span id="who" title="Your name, and what you may do here"></span>'
        f'<button id="leave" hidden>Log out</button></div></header>{HELP}'
        f"<main><h1>Matches <small>{escape(said)}</small></h1>"
        f"{table}{_inbox(arrivals, begun)}{details}</main></body></html>"
    )


def _describe_beginning(inbox: str) -> str:
    """Return what a person does first."""
    begin = '<a href="/">Create one</a>'
    if not inbox:
        return f"{begin} on the pages of the service."
    return f"{begin}, or copy a match folder into the inbox: <code>{escape(inbox)}</code>"


def _row(row: StatusRow, stages: Sequence[str]) -> str:
    match, name = row.match, quote(row.match.match_id, safe="")
    links = [f'<a href="/status?match={name}">cameras</a>'] if match.stages else []
    if match.latest is not None and match.latest.state == "complete":
        links.append(f'<a href="/api/matches/{name}/results/report">report</a>')
    if row.prefect:
        links.append(f'<a href="{escape(row.prefect)}">Prefect</a>')
    title = f'<a href="/#/match/{name}">{escape(match.match_id)}</a>'
    if links:
        title += f"<br><small>{' · '.join(links)}</small>"
    state = f'<span class="state">{escape(match.state)}</span>'
    if row.at_work is not None and row.at_work["state"] == "running":
        state = _at_work(row.at_work)
    if match.latest is not None:
        run = match.latest
        state += f"<br><small>{escape(run.run_id)}, {_time(run.seconds)}, {run.gates}</small>"
        state += f"<br><small>{match.cost}</small>"
    if match.problem:
        problem = escape(in_browser(match.problem))
        cells = f'<td class="failed" colspan="{max(1, len(stages))}">{problem}</td>'
    else:
        cells = "".join(_cell(stage, match.stages.get(stage, ())) for stage in stages)
    return f'<tr><td class="match">{title}</td><td class="run">{state}</td>{cells}</tr>'


def _at_work(run: Mapping[str, Any]) -> str:
    """Render the run at work: percent, and what it does, with the time left."""
    percent = float(run.get("percent", 0.0))
    said = in_browser(" ".join(run.get("lines", ())))
    if not percent:
        return f'<span class="state">at work</span><br><small>{escape(said)}</small>'
    bar = f'<progress max="100" value="{percent:.0f}"></progress>'
    return f'<span class="state">{percent:.0f} %</span> {bar}<br><small>{escape(said)}</small>'


def _cell(stage: str, units: Sequence[UnitSummary]) -> str:
    """Render one stage of a match: the worst unit state, units done, computation time."""
    if not units:
        return '<td class="cell"></td>'
    counts = Counter(unit.state for unit in units)
    worst = next(state for state in WORST_FIRST if counts[state])
    seconds = sum(unit.seconds or 0.0 for unit in units)
    others = [f"{counts[state]} {state}" for state in WORST_FIRST[:-1] if counts[state]]
    words = "<br>".join([f"{counts['done']}/{len(units)}", *others])
    since = [age(unit.waiting_since) for unit in units if unit.state == "waiting"]
    waits = f"<br>for {_time(max(since))}" if since else ""
    took = f"<br><small>{_time(seconds)}</small>" if seconds else ""
    of = escape(stage.replace("_", " "))
    return f'<td class="cell" data-of="{of}"><span class="{worst}">{words}{waits}{took}</span></td>'


def _details(match: MatchStatus) -> str:
    """Render a match's units, stage by stage."""
    rows = "".join(
        f"<tr><td>{escape(stage.replace('_', ' '))}</td><td>{escape(unit.unit)}</td>"
        f'<td><span class="unit {unit.state}">{unit.state}</span></td>'
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
    said = [in_browser(unit.why), *map(reason_words, unit.objections), in_short(unit.figures)]
    return "; ".join(filter(None, said))


def _inbox(arrivals: Iterable[Arrival], begun: Collection[str]) -> str:
    """Render the arrivals; what a match needed before its first run is history once it has one."""
    rows = "".join(
        f'<tr><td data-of="arrival">{escape(each.name)}</td><td data-of="state">{each.state}</td>'
        f'<td data-of="priority">{each.priority}</td>'
        f'<td data-of="since">{when(each.changed_at)}</td>'
        f'<td data-of="match">{escape(each.match_id or "")}</td>'
        f"<td><small>{'' if each.match_id in begun else escape(in_browser(each.reason))}</small>"
        "</td></tr>"
        for each in sorted(arrivals, key=lambda each: each.changed_at, reverse=True)
    )
    if not rows:
        return ""
    heads = "".join(
        f"<th>{name}</th>" for name in ("arrival", "state", "priority", "since", "match", "why")
    )
    return f'<h2>Inbox</h2><div class="wide"><table><tr>{heads}</tr>{rows}</table></div>'


def _as_json(match: MatchStatus, at_work: Mapping[str, Any] | None, prefect: str) -> dict[str, Any]:
    return {
        "match": match.match_id,
        "state": match.state,
        "problem": match.problem,
        "run": None if match.latest is None else match.latest.run_id,
        "seconds": None if match.latest is None else match.latest.seconds,
        "at_work": at_work,
        "prefect": prefect,
        "core_hours": match.cost.core_hours,
        "bytes": match.cost.bytes,
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
