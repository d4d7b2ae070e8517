"""The `worldpose` command.

Exit codes: 0 done, 1 failed, 2 usage, 3 waits for review, 4 partial.
"""

from __future__ import annotations

import gc
import json
import sys

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
from flows.cli.console import errors, line
from worldpose.errors import UsageError, WorldposeError

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


def main() -> None:
    """Run the command line; user errors become one message and an exit code."""
    try:
        app()
    except OSError as error:
        line(f"error: {error.filename or 'a file'}: {error.strerror or error}", to=errors)
        sys.exit(1)
    except WorldposeError as error:
        if "--json" in sys.argv:
            print(json.dumps({"error": type(error).__name__, "message": str(error)}))  # noqa: T201
        line(f"error: {error}", to=errors)
        sys.exit(2 if isinstance(error, UsageError) else 1)
    finally:
        gc.freeze()  # the process ends: freeing all its modules piece by piece takes half a second
