"""Commands run and reprocess: make the results of one match, or of all, current."""

from __future__ import annotations

import time
from collections.abc import Set
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer
from pydantic import JsonValue

from data_contracts.run import EXIT_CODES, GatePolicy, RunRecord
from flows.cli import console
from flows.cli.options import DEFAULT_PROJECT
from flows.cli.settings import print_known
from flows.iterate import Iteration, Iterations, iterate_match
from flows.registering import find_match, find_registration
from flows.reprocess import Reprocessed, State, reprocess_matches
from flows.results.automatic_exports import export_after_run
from flows.review.advice import click_advice, clock_advice
from flows.review.corrections import objections_of
from flows.review.identities import lost_names
from flows.review.metric_words import all_reasons
from flows.review.verdicts import warnings_of
from flows.run_record import alone_with
from flows.run_status import RunStatus
from flows.running import RunRequest, run_match, settle
from flows.settings import parse_overrides, parse_time_limits, selected_stages
from worldpose.errors import UsageError, WorldposeError
from worldpose.store.store import Run, Store

if TYPE_CHECKING:
    from flows.results.comparison import Mark

Marks = list[dict[str, str]]
MAX_REASONS: Final = 3
"""Printed reasons per unit; --json has them all."""
JSON_STATES: Final = {"current": "untouched", "stale": "touched"}
"""Words of --json for states that have no run of their own, as programs know them."""
MAX_LISTED = 5
"""Number of waiting units listed by name."""


def run(
    match: str,
    from_stage: Annotated[str | None, typer.Option("--from")] = None,
    until_stage: Annotated[str | None, typer.Option("--until")] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="STAGE.NAME=VALUE")
    ] = None,
    default_settings: bool = False,
    dask: str | None = None,
    workers: int | None = None,
    time_limits: list[str] | None = None,
    gates: Annotated[GatePolicy | None, typer.Option(metavar="POLICY")] = None,
    iterations: Annotated[str | None, typer.Option(metavar="N")] = None,
    body_folder: Path | None = None,
    verbose: bool = False,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Compute a match's missing and stale results, and nothing else.

    Example: worldpose run matches/tiny --set triangulation.min_views=3

    Options:
        from_stage: First stage; earlier results come from the latest run.
        until_stage: Last stage.
        assignments: A setting for this run and later ones of the match; repeatable; `list` shows
            all settings. All others are as worldpose settings MATCH says.
        default_settings: Forget the settings of stages, iterations and body folder that the match
            states, by earlier runs or otherwise; those of the project and the venue stay.
        gates: When results need review: never (default), auto (metrics beyond limits) or
            always. While the latest run is not complete, or ended before the last stage, its
            policy is the default.
        iterations: Number of iterations. Each one leaves out the keypoints that the bodies of
            the previous one contradict. With auto, the run iterates until the error in held-out
            cameras stops decreasing. Later runs of the match keep the number.
    """
    started = time.monotonic()
    if assignments == ["list"]:
        print_known()
        return
    overrides = parse_overrides(assignments or [], selected_stages(from_stage, until_stage))
    store = Store.open_or_new(project)
    request = RunRequest(
        overrides,
        from_stage,
        until_stage,
        dask,
        workers,
        gates,
        time_limits=parse_time_limits(time_limits or ()),
        default_settings=default_settings,
        iterations=None if iterations is None else parse_iterations(iterations),
        body_folder=None if body_folder is None else str(body_folder.expanduser().absolute()),
    )
    with console.progress(verbose=verbose):
        opened = find_match(store, match)
        with alone_with(store, opened.match_id):
            for text in warnings_of(opened):
                console.line(f"warning: {text}", to=console.errors)
            opened, request = settle(store, opened, request)
            most = request.most_iterations
            passes = None if most == 1 else iterate_match(store, opened, request, most)
            record = run_match(store, opened, request) if passes is None else passes.record
            exported: list[Path] = []
            problem: Exception | None = None
            try:
                exported = export_after_run(store, opened, record)
            except (WorldposeError, OSError) as error:
                problem = error
    seconds = time.monotonic() - started
    warned = [
        *record.warnings,
        *(objections_of(run := Run(store, record)) | lost_names(run)).values(),
        *clock_advice(record.figures, opened.folder.spec),
        *click_advice(record.figures, record.settings),
    ]
    marks = [] if passes is None else marks_of(store, passes)
    console.print_json(
        {
            "run": record.run_id,
            "executed": len(record.executed),
            "reused": len(record.reused),
            "failed": len(record.failed),
            "waiting": len(record.waiting),
            "seconds": round(seconds, 3),
            "blocked": len(record.blocked),
            "failures": [failure.model_dump() for failure in record.failed],
            "gates": record.gates,
            "reviews": [unit.model_dump() for unit in record.waiting],
            "left_out": record.left_out,
            "warnings": warned,
            "usability": record.usability.model_dump(mode="json"),
            **({"exports": [str(path) for path in exported]} if exported else {}),
            **({} if passes is None else _iterations_json(passes, marks)),
        }
    )
    if passes is not None:
        print_iterations(passes, marks)
    _print(record, store.url, seconds)
    for path in exported:
        console.line(f"exported {path}")
    reservations = record.usability.reservations
    for text in dict.fromkeys((*reservations, *warned)):
        kind = "reservation" if text in reservations else "warning"
        console.line(f"{kind}: {text}", to=console.errors)
    if problem is not None:
        console.line(
            f"error: the run is kept, and its exports failed: {problem}", to=console.errors
        )
    raise typer.Exit(EXIT_CODES[record.state] if problem is None else 1)


def _print(record: RunRecord, project: str, seconds: float) -> None:
    by = " until the review" if record.waiting and not record.failed else " by that"
    blocked = f" and {len(record.blocked)} blocked{by}" if record.blocked else ""
    took = f"the whole command, with the start of Prefect: {seconds:.1f} s"
    if record.seconds > seconds:  # nothing was stale: the record is of an earlier command
        took = f"this command: {seconds:.1f} s"
    console.line(
        f"run {record.run_id} of {record.match_id} is {record.state}: "
        f"{len(record.executed)} computed, {len(record.reused)} reused, "
        f"{len(record.failed)} failed{blocked}, gates {record.gates}, "
        f"{record.seconds:.1f} s; {took}"
    )
    count = len(record.usability.reservations)
    verdict = f"{record.usability.verdict}{f' ({count} below)' if count else ''}"
    console.line(f"the results are {verdict}")
    if record.waiting:
        undecided = sum(not unit.rejected for unit in record.waiting)
        rejected = len(record.waiting) - undecided
        also = f", {rejected} rejected and to be corrected" if rejected else ""
        console.line(f"{undecided} {'review' if undecided == 1 else 'reviews'} pending{also}:")
        for unit in record.waiting[:MAX_LISTED]:
            console.line(f"  {unit.request}: {all_reasons(unit.reasons)}")
        if len(record.waiting) > MAX_LISTED:
            console.line(f"  and {len(record.waiting) - MAX_LISTED} more")
    key = "median_stature_m"
    statures = [each[key] for each in record.figures.values() if key in each]
    if statures:
        clips = f" in {len(statures)} clips" if len(statures) > 1 else ""
        console.line(f"median stature of the people: {median(statures):.2f} m{clips}")
    if not (record.executed or record.failed or record.waiting):
        console.line("Nothing to do: every result is current.")
    console.line(f"results: {project}/results/{record.match_id}")
    console.line(f"next: {_next_command(record)}")


def _next_command(record: RunRecord) -> str:
    """Return the most useful command after a run."""
    if record.failed:
        return f"worldpose why {record.match_id}/{record.failed[0].unit}"
    if record.waiting:
        return f"worldpose review serve, to decide; then worldpose run {record.match_id} again"
    if {"body_fitting", "broadcast_tracking"} & {n.partition("/")[0] for n in record.results}:
        return f"worldpose report {record.match_id}"
    return f"worldpose run {record.match_id}, for the stages after these"


def parse_iterations(text: str) -> int | Literal["auto"]:
    """Return the number of iterations, or `auto`."""
    if text == "auto":
        return "auto"
    if text.isascii() and text.isdigit() and int(text) > 0:
        return int(text)
    raise UsageError(
        f"--iterations {text}",
        expected="a number from 1, or auto",
        found=repr(text),
        todo="Read the help: worldpose run --help.",
    )


def figures_of(iteration: Iteration) -> dict[str, float | None]:
    """Return the metrics by which iterations are compared, over all clips."""
    record = iteration.record
    judged = _total(record, "filtering", "judged")
    rejected = _total(record, "filtering", "keypoints_rejected")
    bodies: dict[str, float] = {}
    for stage in ("body_fitting", "refitting"):  # of refitted bodies if available
        for unit, figures in record.figures.items():
            if unit.startswith(f"{stage}/"):
                clip = unit.partition("/")[2]
                bodies |= {f"{clip}.{name}": value for name, value in figures.items()}
    reprojection = [value for name, value in bodies.items() if ".reprojection_px." in name]
    return {
        "held_out_error": iteration.held_out_error,
        "rejected_share": rejected / judged if judged else None,
        "boxes_dropped": _total(record, "filtering", "boxes_dropped"),
        "boxes_of_others": _total(record, "filtering", "boxes_of_others"),
        "bodies": _total(record, "body_fitting", "bodies"),
        "reprojection_px": median(reprojection) if reprojection else None,
        "computed": float(len(record.executed)),
        "seconds": record.seconds,
    }


def marks_of(store: Store, found: Iterations) -> Marks:
    """Compare cameras, clips and players of each iteration with the iteration before."""
    # Imported here: it takes 0.7 s, before Prefect and Dask can start, and few runs iterate.
    from flows.results.comparison import KINDS, compare_runs, count_marks

    shown: tuple[Mark, ...] = ("better", "worse", "mixed", "unchanged")
    marks: Marks = [{}]
    for before, after in pairwise(found.passes):
        changes = compare_runs(store, before.record, after.record)
        counts = {kind: count_marks(changes, kind) for kind in KINDS}
        marks.append(
            {
                kind: " / ".join(str(own.get(mark, 0)) for mark in shown)
                for kind, own in counts.items()
            }
        )
    return marks


def _iterations_json(found: Iterations, marks: Marks) -> dict[str, JsonValue]:
    """Return all iterations with their metrics, and the kept one."""
    return {
        "iterations": [
            {
                "iteration": each.number,
                "run": each.record.run_id,
                **figures_of(each),
                "better_worse_mixed_unchanged": dict(changes),
            }
            for each, changes in zip(found.passes, marks, strict=True)
        ],
        "kept": found.kept.number,
        "ended": found.ended,
    }


def print_iterations(found: Iterations, marks: Marks) -> None:
    """Print one column per iteration, and the kept one."""
    columns = [figures_of(each) for each in found.passes]
    rows = [
        (name, *("" if column[name] is None else f"{column[name]:.4g}" for column in columns))
        for name in columns[0]
    ]
    kinds = dict.fromkeys(kind for each in marks for kind in each)
    rows += [(f"{kind}: b/w/m/u", *(each.get(kind, "") for each in marks)) for kind in kinds]
    heads = [f"{each.number} (run {each.record.run_id})" for each in found.passes]
    console.print_table("iterations", ("metric", *heads), rows)
    signs = "better, worse, mixed, unchanged"
    console.line(f"b/w/m/u: {signs} against the iteration before (worldpose diff)")
    console.line(
        f"iteration {found.kept.number} stands, as run {found.record.run_id}: {found.ended}; "
        "a later one is kept only if people are foreseen better in cameras left out"
    )


def _total(record: RunRecord, stage: str, name: str) -> float:
    return sum(
        figures.get(name, 0.0)
        for unit, figures in record.figures.items()
        if unit.startswith(f"{stage}/")
    )


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
            told.append(_outcome_json(each))
            _print_outcome(each)
    console.print_json({"matches": told})
    if not states:
        console.line("No match is registered. Register one: worldpose ingest FOLDER.")
    raise typer.Exit(exit_code(states))


def exit_code(states: Set[State]) -> int:
    """Return the exit code of the command for the states of the matches."""
    if states & {"failed", "partial"}:
        return 1 if states == {"failed"} else 4
    return 3 if "waiting" in states else 0


def _print_outcome(each: Reprocessed) -> None:
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
        name = unit.planned.name
        name = name if status.latest.iteration == 1 else f"{unit.planned.iteration}: {name}"
        own = [str(reason) for reason in unit.own_reasons]
        more = [f"and {len(own) - MAX_REASONS} more"] * (len(own) > MAX_REASONS)
        inputs = [f"changed inputs: {', '.join(unit.changed_inputs)}"] * bool(unit.changed_inputs)
        rows.append((name, unit.state.value, "\n".join([*own[:MAX_REASONS], *more, *inputs])))
    console.print_table(f"since run {status.latest.run_id}", ("unit", "state", "why"), rows)


def _outcome_json(each: Reprocessed) -> dict[str, JsonValue]:
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
                "unit": unit.planned.name,
                "iteration": unit.planned.iteration,
                "state": unit.state.value,
                "edited": bool(unit.own_reasons),
                "reasons": list(unit.describe()),
            }
            for unit in (() if status is None else status.units)
        ],
    }
