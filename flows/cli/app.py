"""All commands of `worldpose`."""

from __future__ import annotations

import typer

from flows.cli import (
    body,
    check,
    evaluate,
    finetune,
    lineage,
    matches,
    pins,
    programme,
    project,
    reprocess,
    results,
    review,
    run,
    serve,
    statistics,
    times,
)

app = typer.Typer(
    name="worldpose",
    help="Metric 3D poses of every player from many cameras: a data factory.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,  # help names units in brackets
)
for module in (
    project,
    matches,
    programme,
    run,
    reprocess,
    serve,
    review,
    lineage,
    times,
    pins,
    results,
    evaluate,
    check,
    statistics,
    finetune,
    body,
):
    module.add_to(app)
