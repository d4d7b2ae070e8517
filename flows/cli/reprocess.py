"""Command reprocess: recompute everything that edits made stale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer
from pydantic import JsonValue

from flows.cli.computing import DaskOption, TimeLimitOption, WorkersOption
from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    ProjectOption,
    errors,
    line,
    print_json,
    print_table,
    progress,
)
from flows.orchestration.time_limits import parse_time_limits
from flows.registering import find_registration
from flows.reprocessing import Reprocessed, reprocess_matches
from flows.running import RunRequest
from flows.settings import parse_overrides
from flows.touched import Touched
from worldpose.store import Store

SHOWN = 3
"""Printed reasons per unit; --json has them all."""


def reprocess(
    matches: Annotated[
        list[str] | None,
        typer.Argument(metavar="[MATCH]...", help="Ids or folders; every match by default."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only list what would be computed, and why.")
    ] = False,
    retry: Annotated[
        bool, typer.Option("--retry", help="Try again what failed, though nothing was edited.")
    ] = False,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="STAGE.NAME=VALUE",
            help="A setting to ask for, beside those of each match's latest run; may be repeated.",
        ),
    ] = None,
    dask: DaskOption = None,
    workers: WorkersOption = None,
    time_limits: TimeLimitOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Compute anew what an edit, a setting, a detector or new code made stale, match by match.

    Each match is run with the settings, gates and iterations of its latest run, to where that went.
    Exit code 0: all are current; 1: none could be run; 3: some wait for review; 4: some failed.

    Example: worldpose reprocess --dry-run
    """
    overrides = parse_overrides(assignments or [])
    store = Store.open(project)
    wanted = [find_registration(store, name).spec.match_id for name in matches or ()]
    limits = parse_time_limits(time_limits or ())
    request = RunRequest(overrides, dask=dask, workers=workers, time_limits=limits)
    with progress():
        found = reprocess_matches(store, wanted, request, retry=retry, is_rehearsal=dry_run)
    if as_json:
        print_json({"matches": [_as_json(each) for each in found]})
    else:
        _print(found)
    raise typer.Exit(exit_code(found))


def exit_code(found: Sequence[Reprocessed]) -> int:
    """Return the exit code of the command."""
    states = {each.state for each in found}
    if states & {"failed", "partial"}:
        return 1 if states == {"failed"} else 4
    return 3 if "waiting" in states else 0


def _print(found: Sequence[Reprocessed]) -> None:
    if not found:
        line("no match registered: worldpose ingest FOLDER")
    for each in found:
        if each.state in ("never run", "untouched"):
            line(f"{each.match_id}: {_nothing_to_do(each)}")
            continue
        count = 0 if each.touched is None else len(each.touched.to_compute)
        run = "" if each.record is None else f", run {each.record.run_id}"
        line(f"{each.match_id}: {each.state}{run}; {count} units to compute")
        if each.touched is not None:
            _print_units(each.touched)
        if each.problem is not None:
            line(f"error: {each.problem}", to=errors)


def _nothing_to_do(each: Reprocessed) -> str:
    record = each.record
    if record is None:
        return f"no run yet: worldpose run {each.match_id}"
    if record.state in ("failed", "partial"):
        return f"nothing was edited since run {record.run_id} was {record.state}: --retry"
    return "every result is current"


def _print_units(touched: Touched) -> None:
    rows = []
    for unit in touched.units:
        name = unit.unit if touched.latest.iteration == 1 else f"{unit.iteration}: {unit.unit}"
        own = unit.own_reasons
        more = [f"and {len(own) - SHOWN} more"] * (len(own) > SHOWN)
        made_from = [f"made from {', '.join(unit.changed_inputs)}"] * bool(unit.changed_inputs)
        rows.append((name, unit.state, "\n".join([*own[:SHOWN], *more, *made_from])))
    print_table(f"since run {touched.latest.run_id}", ("unit", "state", "why"), rows)


def _as_json(each: Reprocessed) -> dict[str, JsonValue]:
    touched = each.touched
    ran = None if each.state in ("untouched", "touched") else each.record
    return {
        "match": each.match_id,
        "state": each.state,
        "run": None if each.record is None else each.record.run_id,
        "executed": [] if ran is None else list(ran.executed),
        "problem": each.problem,
        "to_compute": 0 if touched is None else len(touched.to_compute),
        "units": [
            {
                "unit": unit.unit,
                "iteration": unit.iteration,
                "state": unit.state,
                "edited": bool(unit.own_reasons),
                "reasons": list(unit.reasons),
            }
            for unit in (() if touched is None else touched.units)
        ],
    }
