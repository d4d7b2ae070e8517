"""Commands on a whole project: init, status, verify, gc, and names of runs: pin, unpin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import typer

from data_contracts.pin import Pin
from flows.cli import console
from flows.match_state import UNREADABLE
from flows.overview import PAGE, read_summary
from flows.registering import find_registration
from flows.results.timings import in_bytes
from flows.run_status import UnitState, find_run
from flows.settings import as_text, flatten
from worldpose.errors import UsageError, WorldposeError
from worldpose.store.garbage import collect, plan_gc
from worldpose.store.integrity import repair
from worldpose.store.integrity import verify as verify_store
from worldpose.store.paths import checked_name, damaged_path
from worldpose.store.runs import list_pins, pin_run, unpin_run
from worldpose.store.store import Store


def init(folder: Annotated[str, typer.Argument(metavar="DIR")]) -> None:
    """Create a project: the folder of registered matches and their results.

    Example: worldpose init worldpose-data

    Options:
        folder: Folder or s3:// URL to create.
    """
    store = Store.create(folder)
    console.answer({"project": store.url}, f"created project {store.url}")


def status(
    store: Store, match: Annotated[str | None, typer.Argument(metavar="[MATCH]")] = None
) -> None:
    """Show which results of each match are current, stale or missing.

    Example: worldpose status tiny-1

    Options:
        match: Match id.
    """
    wanted = [find_registration(store, match).spec.match_id] if match else store.matches()
    if console.output.quiet:
        console.print_json({"matches": [_match_status(store, match_id) for match_id in wanted]})
        return
    if not wanted:
        console.line("No match is registered. Register one: worldpose ingest FOLDER.")
    for first in range(0, len(wanted), PAGE):
        _print_status([_match_status(store, name) for name in wanted[first : first + PAGE]])


def _print_status(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a table of matches, and below it what is to say about each."""
    columns = (
        "match",
        "latest run",
        "state",
        *(f">{state}" for state in STATES),
        ">failed",
        ">waiting",
        "next",
    )
    shown = []
    for row in rows:
        counts = [str(len(row["units"][state])) for state in STATES]
        unsettled = [name for state in STATES[1:] for name in row["units"][state]]
        shown.append(
            (
                row["match"],
                row["run"] or "-",
                row["now"],
                *counts,
                str(len(row["failed"])),
                str(len(row["waiting"])),
                ", ".join(unsettled[:3]) + (" ..." * (len(unsettled) > 3)),
            )
        )
    console.print_table("matches", columns, shown)
    for row in rows:
        if row["problem"]:
            console.line(f"{row['match']}: {row['problem']}")
        judged = row["usability"] or {"verdict": "", "reservations": ()}
        if judged["reservations"]:
            console.line(
                f"{row['match']}: the results of run {row['run']} are {judged['verdict']}:"
            )
        for text in judged["reservations"]:
            console.line(f"  {text}")
        for text in (each for each in row["warnings"] if each not in judged["reservations"]):
            console.line(f"{row['match']}: {text}")
        if row["why"] and row["now"] != judged["verdict"]:
            console.line(f"{row['match']}: {row['now']}. {row['why']} {row['todo']}")
        if row["waiting"]:
            console.line(f"{row['match']}: pending reviews: worldpose review list {row['match']}")
        if len(rows) == 1:
            ended, others = (", ".join(row[key]) or "none" for key in ("runs", "unfinished_runs"))
            console.line(f"{row['match']}: runs that ended: {ended}; that have not: {others}")
        for name, run_id in row["pins"].items():
            console.line(f"{row['match']}: run {run_id} is pinned as {name}")
        if row["settings"]:
            stated = (f"{name}={as_text(it)}" for name, it in flatten(row["settings"]).items())
            console.line(
                f"{row['match']}: judged with the settings of its next run: {', '.join(stated)}"
            )


STATES = tuple(state.value for state in UnitState)
"""States of a unit; see `worldpose why --help`."""


def _match_status(store: Store, match_id: str) -> dict[str, Any]:
    """Return one match's status; what cannot be read is its problem, and hides no other match."""
    found, pins = read_summary(store, match_id), {}
    runs, unfinished = list[str](), list[str]()
    latest, problem = found.latest, found.problem or (found.words == UNREADABLE and found.why)
    said = problem
    try:
        runs = [*store.runs(match_id)]
        unfinished = [run.run_id for run in store.unfinished_runs(match_id)]
        pins = {pin.name: pin.run_id for pin in list_pins(store.blobs, match_id)}
    except (OSError, WorldposeError) as error:
        said = said or str(error)
    return {
        "match": match_id,
        "run": None if latest is None else latest.run_id,
        "state": latest.state if latest else "unreadable" if found.problem else "not run",
        "now": "unreadable" if problem else found.words,
        "why": "" if problem else found.why,
        "todo": "" if problem else found.todo,
        "units": {state: list(found.units.get(state, ())) for state in STATES},
        "failed": [failure.unit for failure in latest.failed] if latest else [],
        "left_out": latest.left_out if latest else {},
        "warnings": list(latest.warnings) if latest else [],
        "usability": latest.usability.model_dump(mode="json") if latest else None,
        "waiting": [each.unit for each in found.waiting],
        "settings": found.settings,
        "runs": runs,
        "unfinished_runs": unfinished,
        "pins": pins,
        "problem": said or None,
    }


def verify(store: Store, mend: Annotated[bool, typer.Option("--repair")] = False) -> None:
    """Check every stored byte against its checksum; exit code 1 if any differs.

    Example: worldpose verify

    Options:
        mend: Withdraw damaged results, which a new run computes, and set damaged records aside
            as *.damaged.
    """
    with console.progress() as reporter:
        findings = verify_store(store, progress=reporter.bytes_read)
    withdrawn, set_aside = repair(store, findings) if mend else ((), ())
    gone = tuple(f"{result.path}/" for result in withdrawn)
    left = [it for it in findings if it.path not in set_aside and not it.path.startswith(gone)]
    console.print_json(
        {
            "findings": [{"path": each.path, "problem": each.problem} for each in findings],
            "withdrawn": [each.path for each in withdrawn],
            "set_aside": list(set_aside),
            "left": [each.path for each in left],
        }
    )
    for finding in findings:
        is_left = mend and finding in left
        told = f"{'left' if is_left else 'found'}: {finding.path}: {finding.problem}"
        again = "; a second reading did not find it" * (is_left and finding.can_be_repaired)
        console.line(told + again, to=console.errors)
    for result in withdrawn:
        console.line(f"withdrawn: {result.path}", to=console.errors)
    for path in set_aside:
        console.line(f"set aside: {damaged_path(path)}", to=console.errors)
    if not mend and any(finding.can_be_repaired for finding in findings):
        console.errors.print(
            "worldpose verify --repair withdraws damaged results and sets damaged records aside; "
            "then run the match with the settings of their runs"
        )
    if findings:
        raise typer.Exit(1)
    console.line("Every stored byte is as it was published.")


def gc(
    store: Store,
    delete: bool = False,
    keep_last: Annotated[int | None, typer.Option(min=1)] = None,
    forget: Annotated[list[str] | None, typer.Option(metavar="MATCH/RUN")] = None,
    older_than: Annotated[float, typer.Option(min=0)] = 24.0,
) -> None:
    """List or remove (--delete) data that no run uses; pinned runs are always kept.

    Example: worldpose gc --keep-last 3 --delete

    Options:
        delete: Remove the listed items; without it, only list them.
        keep_last: Also forget all but the last N runs of each match, and the last of each stage.
        forget: Also forget this run.
        older_than: Keep results and files of no run that are younger than this [h].
    """
    plan = plan_gc(
        store, keep_last=keep_last, forget=forget or [], older_than=timedelta(hours=older_than)
    )
    freed = collect(store, plan) if delete else 0
    rows = [{"path": g.path, "reason": g.reason, "bytes": g.size} for g in plan.garbage]
    counts = Counter(garbage.reason for garbage in plan.garbage)
    told = ", ".join(f"{count} x {reason}" for reason, count in counts.items()) or "nothing"
    console.answer(
        {"garbage": rows, "held": plan.held, "bytes": plan.size, "freed": freed},
        *(f"{garbage.path}  {garbage.reason}" for garbage in plan.garbage),
        *plan.held,
        f"{'removed' if delete else 'to remove with --delete'}: {told} ({in_bytes(plan.size)})",
    )


def pin(
    store: Store,
    run: Annotated[str, typer.Argument(metavar="RUN")],
    name: Annotated[str, typer.Argument(metavar="NAME")],
    who: str,
    why: str = "",
) -> None:
    """Name a run and keep it: gc never forgets a named run, and --run accepts the name.

    Example: worldpose pin tiny-1/0002 paper --who Ada --why "figures of the paper"

    Options:
        run: MATCH/NUMBER, or MATCH: its latest.
        name: Name of the pin, such as v1.
        why: Reason for the pin; it is recorded.
    """
    record = find_run(store, run)
    kept = pin_run(
        store.blobs,
        Pin(
            match_id=record.match_id,
            name=checked_name(name),
            run_id=record.run_id,
            who=who,
            why=why,
            pinned_at=datetime.now(UTC),
        ),
    )
    _say_pin(kept, "pinned")


def unpin(store: Store, named: Annotated[str, typer.Argument(metavar="MATCH/NAME")]) -> None:
    """Remove the name of a run; gc may then forget the run like any other.

    Example: worldpose unpin tiny-1/paper

    Options:
        named: A name given by pin.
    """
    match_id, slash, name = named.partition("/")
    if not (match_id and slash and name):
        raise UsageError(
            f"unpin {named}",
            expected="MATCH/NAME",
            found=repr(named),
            todo="List the names: worldpose status.",
        )
    _say_pin(unpin_run(store.blobs, match_id, name), "unpinned")


def _say_pin(kept: Pin, verb: str) -> None:
    told = f"{verb} run {kept.run_id} of {kept.match_id} as {kept.name}"
    console.answer(kept.model_dump(mode="json"), told)
