"""Command timings: time that each part of a run took."""

from __future__ import annotations

from dataclasses import asdict

from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    MatchArgument,
    ProjectOption,
    RunOption,
    line,
    print_json,
    print_table,
)
from flows.registering import find_registration
from flows.results.timings import run_time
from worldpose.store.store import Store


def timings(
    match: MatchArgument,
    run: RunOption = "latest",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Print the time of each stage of a run, the idle time, core hours and bytes.

    Example: worldpose timings matches/tiny
    """
    store = Store.open(project)
    found = run_time(store, find_registration(store, match).spec.match_id, run)
    if as_json:
        print_json(asdict(found))
        return
    columns = ("stage", ">units", ">elapsed s", ">of the run %", ">work s", ">longest unit s")
    whole = max(found.seconds, 1e-9)
    rows = [
        (
            each.stage,
            str(each.units),
            f"{each.elapsed:.2f}",
            f"{100.0 * each.elapsed / whole:.1f}",
            f"{each.work:.2f}",
            f"{each.longest:.2f}",
        )
        for each in found.stages
    ]
    for name, seconds in (("start", found.start), ("between units", found.between)):
        rows.append((name, "", f"{seconds:.2f}", f"{100.0 * seconds / whole:.1f}", "", ""))
    print_table(f"run {found.run_id}, {found.seconds:.1f} s", columns, rows)
    line(f"all its results, also those of earlier runs: {found.cost}")
    if not found.stages:
        line("nothing was computed by this run; --run names another")
