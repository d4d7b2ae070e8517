"""Parsing and output of `worldpose run --iterations`."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from statistics import median

from pydantic import JsonValue

from data_contracts.run import RunRecord
from flows.cli.console import line, print_table
from flows.iterate import Iteration, Iterations
from flows.results.comparison import KINDS, Mark, compare_runs, count_marks
from worldpose.errors import UsageError
from worldpose.store import Store

UNTIL_BEST = "auto"


def parse_iterations(text: str) -> int | None:
    """Return the number of iterations; None = until one is no better.

    Raises:
        UsageError: neither a number from 1 nor `auto`.
    """
    if text == UNTIL_BEST:
        return None
    if text.isascii() and text.isdigit() and int(text) > 0:
        return int(text)
    raise UsageError(
        f"--iterations {text}",
        expected="a number from 1, or auto",
        found=repr(text),
        todo="See worldpose run --help.",
    )


def figures_of(iteration: Iteration) -> dict[str, float | None]:
    """Return the metrics by which iterations are compared, over all clips."""
    record = iteration.record
    judged = _total(record, "filtering", "judged")
    rejected = _total(record, "filtering", "keypoints_rejected")
    reprojection = [
        value for name, value in _last_bodies(record).items() if ".reprojection_px." in name
    ]
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


def marks_of(store: Store, found: Iterations) -> list[dict[str, str]]:
    """Compare cameras, clips and players of each iteration with the iteration before."""
    marks: list[dict[str, str]] = [{}]
    for before, after in pairwise(found.passes):
        changes = compare_runs(store, before.record, after.record)
        marks.append({kind: _in_short(count_marks(changes, kind)) for kind in KINDS})
    return marks


def _in_short(marks: Mapping[Mark, int]) -> str:
    shown: tuple[Mark, ...] = ("better", "worse", "mixed", "unchanged")
    return " / ".join(str(marks.get(mark, 0)) for mark in shown)


def as_json(store: Store, found: Iterations) -> dict[str, JsonValue]:
    """Return all iterations with their metrics, and the kept one."""
    return {
        "iterations": [
            {
                "iteration": each.number,
                "run": each.record.run_id,
                **figures_of(each),
                "better_worse_mixed_unchanged": dict(marks),
            }
            for each, marks in zip(found.passes, marks_of(store, found), strict=True)
        ],
        "kept": found.kept.number,
        "ended": found.ended,
    }


def print_iterations(store: Store, found: Iterations) -> None:
    """Print one column per iteration, and the kept one."""
    columns = [figures_of(each) for each in found.passes]
    rows = [
        (name, *("" if column[name] is None else f"{column[name]:.4g}" for column in columns))
        for name in columns[0]
    ]
    marks = marks_of(store, found)
    rows += [(f"{kind}: b/w/m/u", *(each.get(kind, "") for each in marks)) for kind in KINDS]
    heads = [f"{each.number} (run {each.record.run_id})" for each in found.passes]
    print_table("iterations", ("figure", *heads), rows)
    line("b/w/m/u: better, worse, mixed, unchanged against the iteration before (worldpose diff)")
    line(
        f"iteration {found.kept.number} stands, as run {found.record.run_id}: {found.ended}; "
        "a later one is kept only if people are foreseen better in cameras left out"
    )


def _total(record: RunRecord, stage: str, name: str) -> float:
    return sum(
        figures.get(name, 0.0)
        for unit, figures in record.figures.items()
        if unit.startswith(f"{stage}/")
    )


def _last_bodies(record: RunRecord) -> dict[str, float]:
    """Return the metrics of the bodies of all clips, `unit.figure`, refitted ones if available."""
    found: dict[str, float] = {}
    for stage in ("body_fitting", "refitting"):
        for unit, figures in record.figures.items():
            if unit.startswith(f"{stage}/"):
                clip = unit.partition("/")[2]
                found |= {f"{clip}.{name}": value for name, value in figures.items()}
    return found
