"""Commands that explain results: diff, why, timings."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from flows.cli import console
from flows.registering import find_registration
from flows.results.comparison import KINDS, compare_runs, count_marks, largest_pose_changes
from flows.results.timings import run_time
from flows.run_status import explain_unit, find_run, run_difference
from flows.settings import parse_overrides
from worldpose.store.store import Store


def diff(
    store: Store,
    run_a: Annotated[str, typer.Argument(metavar="A")],
    run_b: Annotated[str, typer.Argument(metavar="B")],
) -> None:
    """Show what changed between two runs: keys, reasons and metrics, and which parts improved.

    Only metrics where lower is better count. A metric is better or worse if it changed by more than
    1 % and by more than its minimum relevant change (flows/results/comparison.py). A camera, clip
    or player is better if some of its metrics are better and none is worse, worse in the opposite
    case, and mixed if both occur.

    Example: worldpose diff tiny-1/0001 tiny-1/0002

    Options:
        run_a: A run, as MATCH/NUMBER.
        run_b: Another run, as MATCH/NUMBER.
    """
    a, b = find_run(store, run_a), find_run(store, run_b)
    changes = run_difference(store, a, b)
    is_one_match = a.match_id == b.match_id
    compared = compare_runs(store, a, b) if is_one_match else []
    pictures = largest_pose_changes(store, a, b) if is_one_match else []
    found = {
        "units": [asdict(each) for each in changes],
        "compared": [asdict(each) for each in compared],
        "moved": [asdict(each) for each in pictures],
    }
    console.print_json({"a": run_a, "b": run_b, **found})
    rows = [
        (
            change.unit,
            change.state,
            "\n".join(change.reasons),
            "\n".join(f"{name} {old:.4g} -> {new:.4g}" for name, old, new in change.figures),
        )
        for change in changes
    ]
    console.print_table(f"{run_a} to {run_b}", ("unit", "result", "why", "metrics"), rows)
    shown = [
        (
            change.kind,
            change.name,
            change.mark,
            "\n".join(
                f"{each.figure} {each.before:.4g} -> {each.after:.4g}, {each.mark}"
                for each in change.figures
                if each.mark != "unchanged"
            ),
        )
        for change in compared
        if change.mark != "unchanged"
    ]
    if shown:
        console.print_table("better and worse", ("kind", "which", "is", "metrics"), shown)
    for kind in KINDS:
        marks = sorted(count_marks(compared, kind).items())
        if marks:
            console.line(f"{kind}: {', '.join(f'{count} {mark}' for mark, count in marks)}")
    if pictures:
        moved = (
            f"{each.clip}\t{each.camera}\t{each.frame}\t{each.person}\t{each.moved_px:.2f}"
            for each in pictures
        )
        title = "images with the largest changes of people"
        console.print_table(title, "clip\tcamera\t>frame\t>person\t>px", moved)


def why(
    store: Store,
    unit: Annotated[str, typer.Argument(metavar="UNIT")],
    more_settings: list[str] | None = None,
) -> None:
    """Show whether a unit's result is current, and if not, what made it stale.

    current: the latest run has the result that a run would use now; ready: the store has that
    result, but the latest run does not; stale: the latest run has another result; missing: there
    is no result.

    Example: worldpose why tiny-1/triangulation/clip

    Options:
        unit: A unit, as MATCH/STAGE/UNIT.
    """
    found = explain_unit(store, unit, parse_overrides(more_settings or []))
    reasons = (f"  {reason}" for reason in found["reasons"])
    console.answer(found, f"{found['unit']}: {found['state']}", *reasons)


def timings(store: Store, match: str, run: str = "latest") -> None:
    """Print the time of each stage of a run, the idle time, core hours and bytes.

    Example: worldpose timings matches/tiny
    """
    found = run_time(store, find_registration(store, match).spec.match_id, run)
    console.print_json(asdict(found))
    columns = "stage\t>units\t>elapsed s\t>of the run %\t>work s\t>longest unit s"
    percent = 100.0 / max(found.seconds, 1e-9)
    rows = [
        f"{each.stage}\t{each.units}\t{each.elapsed:.2f}\t{percent * each.elapsed:.1f}\t"
        f"{each.work:.2f}\t{each.longest:.2f}"
        for each in found.stages
    ]
    for name, seconds in (("start", found.start), ("between units", found.between)):
        rows.append(f"{name}\t\t{seconds:.2f}\t{percent * seconds:.1f}\t\t")
    title = f"run {found.run_id}, {found.seconds:.1f} s after the start of Prefect"
    console.print_table(title, columns, rows)
    console.line(f"all its results, also those of earlier runs: {found.cost}")
    if not found.stages:
        console.line("nothing was computed by this run; --run names another")
