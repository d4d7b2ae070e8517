"""Output of all commands: lines and tables for people, or one JSON object; progress."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.status import Status
from rich.table import Table
from rich.text import Text

from flows.progress import Reporter, reporting_to
from flows.review.metric_words import all_reasons, in_short

output = Console(soft_wrap=True)
"""Standard output for people; quiet with --json."""
errors = Console(stderr=True, soft_wrap=True)

ERASE_SPINNER = "\r\x1b[2K\x1b[?25h"
"""Control codes of a terminal: erase the current line and show the cursor."""
NO_WIDTH = 100_000
"""Line width without a terminal [characters]."""


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output if the command is asked for it."""
    if output.quiet:
        print(json.dumps(value, indent=2, default=str), flush=True)  # noqa: T201


def line(text: str, *, to: Console = output) -> None:
    """Print plain text without markup: names and messages can contain brackets."""
    to.print(text, markup=False, highlight=False)


def answer(value: Mapping[str, Any], *lines: str) -> None:
    """Print what a command did: one JSON object, or lines for people."""
    print_json(value)
    for text in lines:
        line(text)


def print_table(
    title: str, columns: str | Sequence[str], rows: Iterable[str | Sequence[str]]
) -> None:
    """Print a plain table; columns that start with ">" are right-aligned.

    Cells that are numbers and names can be given as one text with tabs between them. Nothing is
    truncated: a cell too wide for the terminal wraps, and a file or pipe, which people search, gets
    whole lines.
    """
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, title_style="bold")
    for column in _cells(columns):
        justify: Literal["left", "right"] = "right" if column.startswith(">") else "left"
        table.add_column(column.lstrip(">"), justify=justify, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, _cells(row)))
    to = output if output.is_terminal else Console(width=NO_WIDTH, quiet=output.quiet)
    to.print(table, soft_wrap=False)


def _cells(row: str | Sequence[str]) -> Sequence[str]:
    return row.split("\t") if isinstance(row, str) else row


UNIT_WIDTH = 25
"""Width of a unit's name in the progress [characters]: with it a line has at most 80."""


class ConsoleReporter(Reporter):
    """Progress as lines on standard error, one per unit, with a spinner on a terminal."""

    def __init__(self, *, verbose: bool = False) -> None:
        self.verbose, self.computed = verbose, 0
        self.spinner: Status | None = None
        self._started = time.monotonic()
        self._tenths = 0
        self._has_heading = False

    def say(self, text: str) -> None:
        """Print one line, with the seconds since the start."""
        seconds = time.monotonic() - self._started
        width = errors.width if errors.is_terminal else NO_WIDTH
        errors.print(
            Text.from_markup(f"[dim]{seconds:7.1f} s[/]  {text}"),
            width=width,
            overflow="ellipsis",
            no_wrap=True,
            soft_wrap=False,
        )

    def bytes_read(self, done: int, total: int) -> None:
        """Report every tenth of a long read."""
        tenth = 10 * done // max(total, 1)
        if tenth > self._tenths:
            self._tenths = tenth
            self.say(f"{done / 1e6:.1f} of {total / 1e6:.1f} MB checked")

    def tell_kept_settings(self, text: str) -> None:
        """Print the settings in full, on a narrow terminal too."""
        line(text, to=errors)

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """Print the stage and how many of its units are already published."""
        super().stage_started(stage, about, units=units, missing=missing)
        reused = f", {units - missing} already there" if missing < units else ""
        self.say(f"[bold]{stage}[/]: {missing} of {units} to compute{reused}: {escape(about)}")
        if missing and not self._has_heading:
            self._has_heading = True
            self.say(f"[dim]  {'unit':<{UNIT_WIDTH}} {'time':>8}   {'stage':>13}   {'run':>13}[/]")

    def unit_done(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Count the kept result, and report it."""
        self.computed += 1
        super().unit_done(unit, seconds, figures)

    def tell_of(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Print the unit and its time, and how far its stage and the run are."""
        super().tell_of(unit, seconds, figures)
        name = escape(f"{shorten_name(unit):<{UNIT_WIDTH}}")
        at = f"{self.stage_progress!s:>13}   {self.run_progress!s:>13}"
        self.say(f"  {name} {seconds:6.1f} s   {at}")
        if self.verbose and figures:
            line(f"{'':13}{in_short(figures)}", to=errors)

    def unit_waits(self, unit: str, reasons: Sequence[str]) -> None:
        """Print the unit and why it needs review."""
        super().unit_waits(unit, reasons)
        line(f"{'':13}{unit} waits for review: {all_reasons(reasons)}", to=errors)

    def unit_failed(self, unit: str, message: str) -> None:
        """Print the unit and why it failed."""
        super().unit_failed(unit, message)
        line(f"{'':13}{unit} failed: {message}", to=errors)

    def report_interruption(self) -> None:
        """Print what is kept, and how to continue, as the last line of the process.

        A signal handler calls this. The interrupted thread may hold a lock of the console for
        which the thread that draws the spinner waits, so nothing here may wait for that thread.
        """
        results = "result is" if self.computed == 1 else "results are"
        said = f"\ninterrupted: {self.computed} new {results} kept; the same command continues\n"
        number = sys.stderr.fileno()
        terminal = os.dup(number)
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)  # other threads print nothing more
        erase = ERASE_SPINNER if self.spinner is not None else ""
        os.write(terminal, f"{erase}{said}".encode())


def shorten_name(name: str) -> str:
    """Return a name without its middle if it is longer than `UNIT_WIDTH`."""
    if len(name) <= UNIT_WIDTH:
        return name
    end = (UNIT_WIDTH - 1) // 2
    return f"{name[: UNIT_WIDTH - 1 - end]}…{name[-end:]}"


@contextmanager
def progress(*, verbose: bool = False) -> Iterator[ConsoleReporter]:
    """Report progress of all runs inside the context on standard error; verbose: with metrics."""
    reporter = ConsoleReporter(verbose=verbose)
    with reporting_to(reporter):
        if errors.is_terminal:
            with errors.status("working") as reporter.spinner:
                yield reporter
        else:
            yield reporter
