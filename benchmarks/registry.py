"""The benchmarks by name, and the tables that they return as plain data."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Table:
    """One table of results.

    Attributes:
        title: what it shows.
        columns: names; the first column names the rows.
        rows: numbers, texts, and None where there is no value.
        unit: of the numbers, if they all have one.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    unit: str = ""


def show(value: Any) -> str:
    """Return a value as a table has it."""
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def format_table(table: Table) -> str:
    """Return a table in Markdown."""
    title = f"{table.title} [{table.unit}]" if table.unit else table.title
    rows = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "\n".join([title, "", *(f"| {' | '.join(map(show, row))} |" for row in rows), ""])


def as_data(value: Any) -> Any:
    """Return plain data: numbers of Python, and None in place of NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): as_data(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [as_data(each) for each in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


Tables = dict[str, Table]
Option = tuple[tuple[str, ...], dict[str, Any]]


@dataclass(frozen=True)
class Benchmark:
    """A registered benchmark.

    Attributes:
        name: of the command.
        line: what it measures, in one line.
        options: arguments of `add_argument`.
        run: takes the parsed options and returns tables by key.
    """

    name: str
    line: str
    options: tuple[Option, ...]
    run: Callable[[Namespace], Tables]


REGISTRY: dict[str, Benchmark] = {}


def option(*names: str, **how: Any) -> Option:
    """Return an option, with the arguments of `ArgumentParser.add_argument`."""
    return names, how


def benchmark(
    name: str, line: str, *options: Option
) -> Callable[[Callable[[Namespace], Tables]], Callable[[Namespace], Tables]]:
    """Register a function under a name; its docstring describes what the numbers mean."""

    def register(run: Callable[[Namespace], Tables]) -> Callable[[Namespace], Tables]:
        REGISTRY[name] = Benchmark(name, line, options, run)
        return run

    return register


def flatten(metrics: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested metrics by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            found |= flatten(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


DATA = option("data", type=Path, help="folder with the data set, see benchmarks/real.py")
OUT = option("--out", type=Path, help="folder for pictures or results to keep")
SET = option("--set", action="append", default=[], dest="settings", metavar="NAME=VALUE")


def seeds(*default: int) -> Option:
    """Return the option `--seeds`."""
    return option("--seeds", type=int, nargs="+", default=list(default))


def integer(name: str, default: int, what: str = "") -> Option:
    """Return an option with a number."""
    return option(f"--{name}", type=int, default=default, help=what)


def duration(default: float) -> Option:
    """Return the option `--duration`."""
    return option("--duration", type=float, default=default, help="of a match [s]")
