"""Shared parts of all commands: the project and JSON options, output, progress."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from flows.progress import Reporter, in_short, reporting_to

output = Console(soft_wrap=True)
errors = Console(stderr=True, soft_wrap=True)

ProjectOption = Annotated[
    str,
    typer.Option(
        "--project",
        envvar="WORLDPOSE_PROJECT",
        help="Folder or s3:// URL that holds all results.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
MatchArgument = Annotated[
    str, typer.Argument(metavar="MATCH", help="A match folder, or the id of a registered match.")
]
RunOption = Annotated[str, typer.Option("--run", help="A run's number or name; latest by default.")]
StageOption = Annotated[
    str | None, typer.Option("--stage", help="Stage of the joints; the last by default.")
]

DEFAULT_PROJECT = "worldpose-data"
NO_WIDTH = 100_000
"""Line width without a terminal [characters]."""


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output."""
    print(json.dumps(value, indent=2, default=str))  # noqa: T201


def line(text: str, *, to: Console = output) -> None:
    """Print plain text without markup: names and messages can contain brackets."""
    to.print(text, markup=False, highlight=False)


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a plain table; columns that start with ">" are right-aligned.

    Nothing is truncated: a cell too wide for the terminal wraps, and a file or pipe, which people
    search, gets whole lines.
    """
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, title_style="bold")
    for column in columns:
        justify: Literal["left", "right"] = "right" if column.startswith(">") else "left"
        table.add_column(column.lstrip(">"), justify=justify, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    to = output if output.is_terminal else Console(width=NO_WIDTH)
    to.print(table, soft_wrap=False)


class ConsoleReporter(Reporter):
    """Progress as lines on standard error, with a spinner on a terminal."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._tenths = 0

    def say(self, text: str) -> None:
        """Print one line, with the seconds since the start."""
        seconds = time.monotonic() - self._started
        errors.print(f"[dim]{seconds:7.1f} s[/]  {text}", highlight=False)

    def bytes_read(self, done: int, total: int) -> None:
        """Report every tenth of a long read."""
        tenth = 10 * done // max(total, 1)
        if tenth > self._tenths:
            self._tenths = tenth
            self.say(f"{done / 1e6:.1f} of {total / 1e6:.1f} MB checked")

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """Print the stage and how many of its units are already published."""
        super().stage_started(stage, about, units=units, missing=missing)
        reused = f", {units - missing} already there" if missing < units else ""
        self.say(f"[bold]{stage}[/]: {about} ({missing} of {units} to compute{reused})")

    def tell_of(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Print the unit, its time and its metrics."""
        super().tell_of(unit, seconds, figures)
        self.say(
            f"  {escape(unit)}  {seconds:.2f} s  [dim]{in_short(figures)}[/]  ({self.left} left)"
        )

    def unit_waits(self, unit: str, reasons: Sequence[str]) -> None:
        """Print the unit and why it needs review."""
        super().unit_waits(unit, reasons)
        self.say(f"  [bold]{escape(unit)} waits for review[/]: {escape('; '.join(reasons))}")

    def unit_failed(self, unit: str, message: str) -> None:
        """Print the unit and why it failed."""
        super().unit_failed(unit, message)
        self.say(f"  [bold red]{escape(unit)} failed[/]: {escape(message)}  ({self.left} left)")


@contextmanager
def progress() -> Iterator[ConsoleReporter]:
    """Report progress of all runs inside the context as lines on standard error."""
    reporter = ConsoleReporter()
    with reporting_to(reporter):
        if errors.is_terminal:
            with errors.status("working"):
                yield reporter
        else:
            yield reporter
