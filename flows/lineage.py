"""Provenance of results: differences between runs, and reasons for staleness."""

from __future__ import annotations

from dataclasses import dataclass

from data_contracts.run import RunRecord
from flows.method import METHOD
from flows.registering import open_match
from flows.run_plan import plan_run
from flows.run_record import latest_run, resolve_settings
from flows.run_status import recorded_differences, recorded_recipe, unit_status
from flows.settings import Overrides
from worldpose.errors import InputError
from worldpose.store.runs import list_pins
from worldpose.store.store import Store


@dataclass(frozen=True)
class UnitChange:
    """Change of one unit between two runs.

    Attributes:
        unit: name as `stage/unit`.
        state: same, changed, only in A, only in B.
        reasons: differences between the recipes.
        figures: name, value in A, value in B of the metrics that differ.
    """

    unit: str
    state: str
    reasons: tuple[str, ...]
    figures: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class Explanation:
    """State of a unit (`UnitState`), its current key, and the reasons as lines for people."""

    unit: str
    state: str
    key: str
    reasons: tuple[str, ...]


def find_run(store: Store, name: str) -> RunRecord:
    """Return the run named by `match/number` or `match/name`, or `match` for its latest.

    Raises:
        InputError: no such run.
    """
    match_id, _, number = name.partition("/")
    runs = store.runs(match_id) if match_id in store.matches() else []
    names = {pin.name: pin.run_id for pin in list_pins(store.blobs, match_id)} if runs else {}
    run_id = names.get(number, number) or (runs[-1] if runs else "")
    if run_id not in runs:
        raise InputError(
            name,
            expected=f"MATCH/NUMBER or MATCH/NAME, of {', '.join(store.matches()) or '(none)'}",
            found=f"runs {', '.join((*runs, *names))}" if runs else "no run of that match",
            todo="List the runs: worldpose status.",
        )
    return store.run(match_id, run_id)


def run_difference(store: Store, a: RunRecord, b: RunRecord) -> list[UnitChange]:
    """Compare each unit between two runs, in the order of the method."""
    changes = []
    for unit in sorted(a.results.keys() | b.results.keys(), key=_method_order):
        if unit not in b.results:
            changes.append(UnitChange(unit, "only in A", (), ()))
        elif unit not in a.results:
            changes.append(UnitChange(unit, "only in B", (), ()))
        elif a.results[unit] == b.results[unit]:
            changes.append(UnitChange(unit, "same", (), ()))
        else:
            differences = recorded_differences(store, a, unit, recorded_recipe(store, b, unit))
            reasons = tuple(str(each) for each in differences)
            old, new = (run.figures.get(unit, {}) for run in (a, b))
            figures = tuple(
                (name, old[name], new[name])
                for name in old
                if name in new and old[name] != new[name]
            )
            changes.append(UnitChange(unit, "changed", reasons, figures))
    return changes


def explain_unit(store: Store, name: str, overrides: Overrides) -> Explanation:
    """Return a unit's state and the reasons for it.

    Args:
        store: the store.
        name: unit as `match/stage/unit`.
        overrides: requested settings beyond those of the latest run.

    Raises:
        InputError: no such unit.
    """
    match_id, _, unit_name = name.partition("/")
    match = open_match(store, match_id)
    latest = latest_run(store, match_id)
    asked, _ = resolve_settings(store, match_id, latest, overrides)
    iteration = 1 if latest is None else latest.iteration
    planned = {unit.name: unit for unit in plan_run(store, match, asked, iteration=iteration)}
    if unit_name not in planned:
        raise InputError(
            name,
            expected=f"a unit of {match_id}: {', '.join(planned)}",
            found=repr(unit_name),
            todo="Write it as MATCH/STAGE/UNIT.",
        )
    status = unit_status(store, planned[unit_name], latest)
    failed = () if latest is None else latest.failed
    failures = tuple(
        f"run {match_id}/{latest.run_id} failed with the same input and settings: {each.message}"
        for each in failed
        if latest is not None and each.unit == unit_name and each.key == status.planned.key
    )
    reasons = failures or status.describe()
    return Explanation(name, status.state.value, status.planned.key, reasons)


def _method_order(unit: str) -> tuple[int, str]:
    stage = unit.partition("/")[0]
    names = [each.name for each in METHOD]
    return (names.index(stage) if stage in names else len(names), unit)
