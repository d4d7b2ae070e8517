"""Command run: make a match's results current."""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer

from data_contracts.run import RunRecord
from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    MatchArgument,
    ProjectOption,
    errors,
    line,
    print_json,
    print_table,
    progress,
)
from flows.method import METHOD
from flows.registering import find_match
from flows.running import RunRequest, run_match
from flows.settings import parse_overrides, selected_stages
from worldpose.store import Store

EXIT_CODES = {"complete": 0, "failed": 1, "partial": 4}


def run(
    match: MatchArgument,
    from_stage: Annotated[
        str | None,
        typer.Option("--from", help="First stage; earlier results are taken as they stand."),
    ] = None,
    until_stage: Annotated[str | None, typer.Option("--until", help="Last stage.")] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="STAGE.NAME=VALUE",
            help="A setting for this run; may be repeated; `list` shows them all.",
        ),
    ] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDR", help="A running Dask scheduler, tcp://host:port.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Worker processes on this machine; one a core.")
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Compute whatever is missing or stale of a match, and nothing else.

    Example: worldpose run matches/tiny --set triangulation.min_views=3
    """
    started = time.monotonic()
    if assignments == ["list"]:
        _print_settings(as_json)
        return
    overrides = parse_overrides(assignments or [], selected_stages(from_stage, until_stage))
    store = Store.open_or_new(project)
    request = RunRequest(overrides, from_stage, until_stage, dask, workers)
    with progress():
        record = run_match(store, find_match(store, match), request)
    seconds = time.monotonic() - started
    if as_json:
        print_json(
            {
                "run": record.run_id,
                "executed": len(record.executed),
                "reused": len(record.reused),
                "failed": len(record.failed),
                "waiting": 0,
                "seconds": round(seconds, 3),
                "blocked": len(record.blocked),
                "failures": [failure.model_dump() for failure in record.failed],
            }
        )
    else:
        _print(record, store.url, seconds)
    raise typer.Exit(EXIT_CODES[record.state])


def _print_settings(as_json: bool) -> None:
    rows = [
        (
            f"{stage.name}.{name}",
            json.dumps(stage.settings().model_dump(mode="json")[name]),
            " ".join((field.description or "").split()),
        )
        for stage in METHOD
        for name, field in stage.settings.model_fields.items()
    ]
    if as_json:
        print_json(
            {
                name: {"default": json.loads(default), "about": about}
                for name, default, about in rows
            }
        )
    else:
        print_table("settings", ("setting", "default", "what it says"), rows)


def _print(record: RunRecord, project: str, seconds: float) -> None:
    blocked = f" and {len(record.blocked)} blocked by that" if record.blocked else ""
    line(
        f"run {record.run_id} of {record.match_id} is {record.state}: "
        f"{len(record.executed)} computed, {len(record.reused)} reused, "
        f"{len(record.failed)} failed{blocked}, {seconds:.1f} s"
    )
    if not (record.executed or record.failed):
        line("nothing to do: every result is current")
    for name, figures in record.figures.items():
        if figures.get("joints") == 0:
            line(
                f"warning: {name} found nobody. Are translations in metres, the cameras in step, "
                "and the settings within reach of these cameras?",
                to=errors,
            )
    line(f"results: {project}/results/{record.match_id}")


def add_to(app: typer.Typer) -> None:
    """Register this command."""
    app.command()(run)
