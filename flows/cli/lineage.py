"""Commands that explain results: diff, why."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    ProjectOption,
    line,
    print_json,
    print_table,
)
from flows.lineage import explain_unit, find_run, run_difference
from flows.settings import parse_overrides
from worldpose.store import Store


def diff(
    run_a: Annotated[str, typer.Argument(metavar="A", help="A run, as MATCH/NUMBER.")],
    run_b: Annotated[str, typer.Argument(metavar="B", help="Another run, as MATCH/NUMBER.")],
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Say what changed between two runs: keys, reasons and figures, unit by unit.

    Example: worldpose diff tiny-1/0001 tiny-1/0002
    """
    store = Store.open(project)
    changes = run_difference(store, find_run(store, run_a), find_run(store, run_b))
    if as_json:
        print_json({"a": run_a, "b": run_b, "units": [asdict(change) for change in changes]})
        return
    rows = [
        (
            change.unit,
            change.state,
            "\n".join(change.reasons),
            "\n".join(f"{name} {old:.4g} -> {new:.4g}" for name, old, new in change.figures),
        )
        for change in changes
    ]
    print_table(f"{run_a} to {run_b}", ("unit", "result", "why", "figures"), rows)


def why(
    unit: Annotated[str, typer.Argument(metavar="UNIT", help="A unit, as MATCH/STAGE/UNIT.")],
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="STAGE.NAME=VALUE",
            help="Ask for these settings; those of the latest run by default.",
        ),
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Say whether a unit's result is current, and if not, what made it stale.

    current: the latest run has what a run would give now; ready: the store has it, the latest
    run has not; stale: the latest run has another; missing: there is none.

    Example: worldpose why tiny-1/triangulation/clip
    """
    answer = explain_unit(Store.open(project), unit, parse_overrides(assignments or []))
    if as_json:
        print_json(asdict(answer))
        return
    line(f"{answer.unit}: {answer.state}")
    for reason in answer.reasons:
        line(f"  {reason}")


def add_to(app: typer.Typer) -> None:
    """Register these commands."""
    for command in (diff, why):
        app.command()(command)
