"""Command run: make a match's results current."""

from __future__ import annotations

import json
import time
from typing import Annotated, get_args

import typer

from data_contracts.run import GatePolicy, RunRecord
from flows.cli.computing import DaskOption, TimeLimitOption, WorkersOption
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
from flows.cli.iterations import as_json as iterations_as_json
from flows.cli.iterations import parse_iterations, print_iterations
from flows.iterate import iterate_match
from flows.method import METHOD
from flows.orchestration.time_limits import parse_time_limits
from flows.registering import find_match
from flows.review.click_advice import click_advice
from flows.review.clock_advice import clock_advice
from flows.review.verdicts import warnings_of
from flows.running import RunRequest, run_match
from flows.settings import parse_overrides, selected_stages
from worldpose.errors import UsageError
from worldpose.store import Store

EXIT_CODES = {"complete": 0, "failed": 1, "waiting": 3, "partial": 4}
SHOWN = 5
"""Number of waiting units listed by name."""


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
    dask: DaskOption = None,
    workers: WorkersOption = None,
    time_limits: TimeLimitOption = None,
    gates: Annotated[
        str | None,
        typer.Option(
            metavar="POLICY",
            help="When results wait for a person: never (default), auto (figures beyond limits) "
            "or always; while the latest run waits, as in that.",
        ),
    ] = None,
    iterations: Annotated[
        str,
        typer.Option(
            metavar="N",
            help="How often to go through the method, each time without the keypoints that the "
            "bodies of the time before contradict; auto: until left-out cameras are foreseen no "
            "better.",
        ),
    ] = "1",
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
    policy = None if gates is None else _policy(gates)
    most = parse_iterations(iterations)
    request = RunRequest(
        overrides,
        from_stage,
        until_stage,
        dask,
        workers,
        policy,
        time_limits=parse_time_limits(time_limits or ()),
    )
    with progress():
        opened = find_match(store, match)
        for text in warnings_of(opened):
            line(f"warning: {text}", to=errors)
        passes = None if most == 1 else iterate_match(store, opened, request, most)
        record = run_match(store, opened, request) if passes is None else passes.record
    seconds = time.monotonic() - started
    warned = [
        *record.warnings,
        *clock_advice(record.figures, opened.folder.spec),
        *click_advice(record.figures, _stated_click_noise(record)),
    ]
    if as_json:
        print_json(
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
                **({} if passes is None else iterations_as_json(store, passes)),
            }
        )
    else:
        if passes is not None:
            print_iterations(store, passes)
        _print(record, store.url, seconds)
    for text in warned:
        line(f"warning: {text}", to=errors)
    raise typer.Exit(EXIT_CODES[record.state])


def _stated_click_noise(record: RunRecord) -> float:
    stated = record.settings.get("static_calibration", {}).get("click_noise")
    return float(stated) if isinstance(stated, int | float) else 1.0


def _policy(gates: str) -> GatePolicy:
    policies: tuple[GatePolicy, ...] = get_args(GatePolicy)
    for policy in policies:
        if gates == policy:
            return policy
    raise UsageError(
        f"--gates {gates}",
        expected="never, auto or always",
        found=repr(gates),
        todo="See worldpose run --help.",
    )


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
        f"{len(record.failed)} failed{blocked}, gates {record.gates}, {seconds:.1f} s"
    )
    _print_waiting(record)
    if not (record.executed or record.failed or record.waiting):
        line("nothing to do: every result is current")
    line(f"results: {project}/results/{record.match_id}")


def _print_waiting(record: RunRecord) -> None:
    """Print the units that need review, and how to review them."""
    if not record.waiting:
        return
    undecided = sum(not unit.rejected for unit in record.waiting)
    rejected = len(record.waiting) - undecided
    also = f", {rejected} rejected and to be corrected" if rejected else ""
    line(f"{undecided} {'review' if undecided == 1 else 'reviews'} pending{also}:")
    for unit in record.waiting[:SHOWN]:
        line(f"  {unit.request}: {'; '.join(unit.reasons)}")
    if len(record.waiting) > SHOWN:
        line(f"  and {len(record.waiting) - SHOWN} more")
    line(
        f"next: worldpose review list {record.match_id}, then approve or reject what it lists, "
        "and give this command again"
    )
