"""Command run: make a match's results current."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from data_contracts.run import RunRecord
from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    MatchArgument,
    ProjectOption,
    line,
    print_json,
    progress,
)
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
        typer.Option("--set", metavar="STAGE.NAME=VALUE", help="A setting; may be repeated."),
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


def _print(record: RunRecord, project: str, seconds: float) -> None:
    blocked = f" and {len(record.blocked)} blocked by that" if record.blocked else ""
    line(
        f"run {record.run_id} of {record.match_id} is {record.state}: "
        f"{len(record.executed)} computed, {len(record.reused)} reused, "
        f"{len(record.failed)} failed{blocked}, {seconds:.1f} s"
    )
    if not (record.executed or record.failed):
        line("nothing to do: every result is current")
    line(f"results: {project}/results/{record.match_id}")


def add_to(app: typer.Typer) -> None:
    """Register this command."""
    app.command()(run)
