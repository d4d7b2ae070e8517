"""Command reprocess: recompute all results that edits made stale."""

from __future__ import annotations

from collections.abc import Set
from typing import Annotated, Final

import typer
from pydantic import JsonValue

from flows.cli import console
from flows.orchestration.time_limits import parse_time_limits
from flows.registering import find_registration
from flows.reprocess import Reprocessed, State, reprocess_matches
from flows.run_status import RunStatus
from flows.running import RunRequest
from flows.settings import parse_overrides
from worldpose.store.store import Store

MAX_REASONS: Final = 3
"""Printed reasons per unit; --json has them all."""
JSON_STATES: Final = {"current": "untouched", "stale": "touched"}
"""Words of --json for states that have no run of their own, as programs know them."""


def reprocess(
    store: Store,
    matches: Annotated[list[str] | None, typer.Argument(metavar="[MATCH]...")] = None,
    dry_run: bool = False,
    retry: bool = False,
    more_settings: list[str] | None = None,
    dask: str | None = None,
    workers: int | None = None,
    time_limits: list[str] | None = None,
    verbose: bool = False,
) -> None:
    """Recompute results that an edit, a setting, a detector or new code made stale.

    Each match is run as worldpose settings MATCH says, up to the last stage of its latest run. Exit
    code 0: all matches are current or at work; 1: none could be run; 3: some wait for review; 4:
    some failed.

    Example: worldpose reprocess --dry-run

    Options:
        matches: Ids or folders; all matches by default.
        dry_run: Only list the units to compute, with reasons.
        retry: Retry failed units, even without an edit.
    """
    overrides = parse_overrides(more_settings or [])
    wanted = [find_registration(store, name).spec.match_id for name in matches or ()]
    limits = parse_time_limits(time_limits or ())
    request = RunRequest(overrides, dask=dask, workers=workers, time_limits=limits)
    with console.progress(verbose=verbose):
        states, told = set(), []
        for each in reprocess_matches(store, wanted, request, retry=retry, is_rehearsal=dry_run):
            states.add(each.state)
            told.append(_as_json(each))
            _print(each)
    console.print_json({"matches": told})
    if not states:
        console.line("No match is registered. Register one: worldpose ingest FOLDER.")
    raise typer.Exit(exit_code(states))


def exit_code(states: Set[State]) -> int:
    """Return the exit code of the command for the states of the matches."""
    if states & {"failed", "partial"}:
        return 1 if states == {"failed"} else 4
    return 3 if "waiting" in states else 0


def _print(each: Reprocessed) -> None:
    if each.state in ("never run", "current", "at work"):
        console.line(f"{each.match_id}: {_nothing_to_do(each)}")
        return
    count = 0 if each.status is None else len(each.status.to_compute)
    run = "" if each.record is None else f", run {each.record.run_id}"
    console.line(f"{each.match_id}: {each.state}{run}; {count} units to compute")
    if each.status is not None:
        _print_units(each.status)
    if each.problem is not None:
        console.line(f"error: {each.problem}", to=console.errors)


def _nothing_to_do(each: Reprocessed) -> str:
    record = each.record
    if each.state == "at work":
        return f"at work. {each.problem}"
    if record is None:
        return f"no run yet; start one: worldpose run {each.match_id}"
    if record.state in ("failed", "partial"):
        return (
            f"nothing was edited since run {record.run_id}, which is {record.state}; "
            "--retry repeats its failed units"
        )
    return "every result is current"


def _print_units(status: RunStatus) -> None:
    rows = []
    for unit in status.units:
        name = unit.unit if status.latest.iteration == 1 else f"{unit.iteration}: {unit.unit}"
        own = [str(reason) for reason in unit.own_reasons]
        more = [f"and {len(own) - MAX_REASONS} more"] * (len(own) > MAX_REASONS)
        inputs = [f"changed inputs: {', '.join(unit.changed_inputs)}"] * bool(unit.changed_inputs)
        rows.append((name, unit.state.value, "\n".join([*own[:MAX_REASONS], *more, *inputs])))
    console.print_table(f"since run {status.latest.run_id}", ("unit", "state", "why"), rows)


def _as_json(each: Reprocessed) -> dict[str, JsonValue]:
    status = each.status
    ran = None if each.state in JSON_STATES else each.record
    return {
        "match": each.match_id,
        "state": JSON_STATES.get(each.state, each.state),
        "run": None if each.record is None else each.record.run_id,
        "executed": [] if ran is None else list(ran.executed),
        "problem": each.problem,
        "to_compute": 0 if status is None else len(status.to_compute),
        "units": [
            {
                "unit": unit.unit,
                "iteration": unit.iteration,
                "state": unit.state.value,
                "edited": bool(unit.own_reasons),
                "reasons": list(unit.describe()),
            }
            for unit in (() if status is None else status.units)
        ],
    }
