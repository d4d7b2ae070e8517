"""Commands that explain results: diff, why."""

from __future__ import annotations

from typing import Annotated

import typer

from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    ProjectOption,
    output,
    print_json,
    table,
)
from flows.lineage import explain_unit, find_run, run_difference
from flows.planning import parse_overrides
from worldpose.store import Store


def diff(
    run_a: Annotated[str, typer.Argument(metavar="A", help="A run, as MATCH/NUMBER.")],
    run_b: Annotated[str, typer.Argument(metavar="B", help="Another run, as MATCH/NUMBER.")],
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Say what changed between two runs: keys, reasons and figures, unit by unit.

    Example: worldpose diff tiny/0001 tiny/0002
    """
    store = Store.open(project)
    changes = run_difference(store, find_run(store, run_a), find_run(store, run_b))
    if as_json:
        print_json({"a": run_a, "b": run_b, "units": [change.as_dict() for change in changes]})
        return
    shown = table(f"{run_a} to {run_b}", "unit", "result", "why", "figures")
    for change in changes:
        figures = "\n".join(
            f"{name} {before:.4g} -> {after:.4g}" for name, before, after in change.figures
        )
        shown.add_row(change.unit, change.state, "\n".join(change.reasons), figures)
    output.print(shown)


def why(
    unit: Annotated[str, typer.Argument(metavar="UNIT", help="A unit, as MATCH/STAGE/UNIT.")],
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="STAGE.NAME=VALUE", help="Ask for these settings."),
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Say whether a unit's result is current, and if not, what made it stale.

    Example: worldpose why tiny/triangulation/clip
    """
    store = Store.open(project)
    answer = explain_unit(store, unit, parse_overrides(assignments or []))
    if as_json:
        print_json(answer.as_dict())
        return
    output.print(f"{answer.unit}: {answer.state}", highlight=False)
    for reason in answer.reasons:
        output.print(f"  {reason}", highlight=False)


def add_to(app: typer.Typer) -> None:
    """Register these commands."""
    for command in (diff, why):
        app.command()(command)
