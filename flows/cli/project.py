"""Commands on a whole project: init, status, verify, gc."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated

import typer

from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    ProjectOption,
    errors,
    output,
    print_json,
    progress,
    table,
)
from flows.planning import plan_run
from flows.registering import open_match
from flows.run_record import latest_run
from worldpose.store import Store, collect, plan_gc, repair
from worldpose.store import verify as verify_store


def init(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Folder or s3:// URL to make.")],
    as_json: JsonOption = False,
) -> None:
    """Make a project: the place where matches are registered and results are kept.

    Example: worldpose init worldpose-data
    """
    store = Store.create(folder)
    if as_json:
        print_json({"project": store.url})
    else:
        output.print(f"made project {store.url}")


def status(
    match: Annotated[str | None, typer.Argument(metavar="[MATCH]", help="Id of a match.")] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Show which results are there, stale or missing, match by match.

    Example: worldpose status tiny
    """
    store = Store.open(project)
    rows = [_match_status(store, match_id) for match_id in ([match] if match else store.matches())]
    if as_json:
        print_json({"matches": rows})
        return
    shown = table("matches", "match", "latest run", "state", ">current", ">stale", "not current")
    for row in rows:
        stale = row["stale"]
        shown.add_row(
            row["match"],
            row["run"] or "-",
            row["state"],
            str(len(row["current"])),
            str(len(stale)),
            ", ".join(stale[:4]) + (" ..." if len(stale) > 4 else ""),
        )
    output.print(shown if rows else "no match registered: worldpose ingest FOLDER")


def _match_status(store: Store, match_id: str) -> dict:
    match = open_match(store, match_id)
    latest = latest_run(store, match_id)
    overrides = {} if latest is None else latest.overrides
    planned = plan_run(store, match, overrides)
    return {
        "match": match_id,
        "run": None if latest is None else latest.run_id,
        "state": "not run" if latest is None else latest.state,
        "unfinished_runs": [run.run_id for run in store.unfinished_runs(match_id)],
        "current": [unit.name for unit in planned if unit.published],
        "stale": [unit.name for unit in planned if not unit.published],
        "failed": [] if latest is None else [failure.unit for failure in latest.failed],
    }


def verify(
    mend: Annotated[
        bool,
        typer.Option("--repair", help="Withdraw damaged results; a new run computes them."),
    ] = False,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Check every stored byte against its checksum; exit code 1 if any differs.

    Example: worldpose verify
    """
    store = Store.open(project)
    with progress() as reporter:
        findings = verify_store(store, progress=reporter.bytes_read)
    withdrawn = repair(store, findings) if mend else ()
    if as_json:
        print_json(
            {
                "findings": [{"path": each.path, "problem": each.problem} for each in findings],
                "withdrawn": [each.path for each in withdrawn],
            }
        )
    for finding in findings:
        errors.print(f"[bold red]damaged:[/] {finding.path}: {finding.problem}", highlight=False)
    for result in withdrawn:
        errors.print(f"withdrawn: {result.path}", highlight=False)
    if findings and not mend:
        errors.print(
            "worldpose verify --repair withdraws what is damaged; then run the match again"
        )
    if findings:
        raise typer.Exit(1)
    if not as_json:
        output.print("every stored byte is as it was published")


def gc(
    delete: Annotated[
        bool, typer.Option("--delete", help="Remove what is listed; without it only list.")
    ] = False,
    keep_last: Annotated[
        int | None, typer.Option(min=1, help="Also forget all but this many runs of each match.")
    ] = None,
    forget: Annotated[
        list[str] | None, typer.Option(metavar="MATCH/RUN", help="Also forget this run.")
    ] = None,
    older_than: Annotated[
        float, typer.Option(min=0, help="Spare leftovers younger than this [h].")
    ] = 24.0,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """List, and with --delete remove, what no run reaches.

    Example: worldpose gc --keep-last 3 --delete
    """
    store = Store.open(project)
    plan = plan_gc(
        store, keep_last=keep_last, forget=forget or [], older_than=timedelta(hours=older_than)
    )
    freed = collect(store, plan) if delete else 0
    if as_json:
        rows = [{"path": g.path, "reason": g.reason, "bytes": g.size} for g in plan.garbage]
        print_json({"garbage": rows, "held": plan.held, "bytes": plan.size, "freed": freed})
        return
    for garbage in plan.garbage:
        output.print(f"{garbage.path}  {garbage.reason}", highlight=False)
    for line in plan.held:
        output.print(line, highlight=False)
    verb = "removed" if delete else "no run reaches"
    output.print(f"{verb} {len(plan.garbage)} things, {plan.size / 1e6:.1f} MB")


def add_to(app: typer.Typer) -> None:
    """Register these commands."""
    for command in (init, status, verify, gc):
        app.command()(command)
