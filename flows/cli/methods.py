"""Printed table of baseline methods."""

from __future__ import annotations

import math
from collections.abc import Sequence

from data_contracts.evaluation import MethodScore
from flows.cli.console import line, print_json, print_table
from worldpose.errors import UsageError
from worldpose.evaluation.method_table import COLUMNS, table_csv, table_latex, table_rows

FORMS = ("text", "csv", "latex")


def named_rates(given: Sequence[str]) -> dict[str, float]:
    """Parse NAME=FPS arguments into numbers by name.

    Raises:
        UsageError: an argument has another form.
    """
    rates = {}
    for item in given:
        name, _, text = item.partition("=")
        try:
            rates[name] = float(text)
        except ValueError:
            rates[name] = 0.0
        if not 0.0 < rates[name] < math.inf:
            raise UsageError(
                f"--method-fps {item}",
                expected="NAME=FPS, such as gvhmr=30",
                found=repr(text),
                todo="Give the frames in a second of the video that the method saw.",
            )
    return rates


def print_methods(scores: Sequence[MethodScore], form: str, *, as_json: bool) -> None:
    """Print scores of methods as text, CSV or LaTeX, or in full as JSON.

    Raises:
        UsageError: an unknown format.
    """
    if form not in FORMS:
        raise UsageError(
            f"--table {form}", expected=", ".join(FORMS), found=repr(form), todo="Choose one."
        )
    if as_json:
        rows = [score.model_dump(mode="json", exclude_none=True) for score in scores]
        print_json({"methods": rows, "table": [list(row) for row in table_rows(scores)]})
    elif form == "text":
        # Brackets would be parsed as markup.
        titles = (f">{title.replace('[', '').replace(']', '')}" for title in COLUMNS.values())
        print_table("", ("method", *titles), table_rows(scores))
    else:
        line((table_csv if form == "csv" else table_latex)(scores).rstrip())
