"""Provenance of results: differences between runs, and reasons for staleness."""

from __future__ import annotations

from dataclasses import dataclass

from data_contracts.run import RunRecord
from data_contracts.work import Recipe
from flows.method import METHOD
from flows.planning import PlannedUnit, plan_run
from flows.registering import open_match
from flows.run_record import latest_run
from flows.settings import Overrides
from worldpose.errors import InputError
from worldpose.store import Store, explain_difference, list_pins


@dataclass(frozen=True)
class UnitChange:
    """Change of one unit between two runs.

    Attributes:
        unit: as `stage/unit`.
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
    """State of a unit (`unit_state`), its current key, and the reasons."""

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
            todo="See worldpose status.",
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
            reasons = _why_differs(store, a, unit, _recipe(store, b, unit))
            old, new = (run.figures.get(unit, {}) for run in (a, b))
            figures = tuple(
                (name, old[name], new[name])
                for name in old
                if name in new and old[name] != new[name]
            )
            changes.append(UnitChange(unit, "changed", reasons, figures))
    return changes


def unit_state(unit: PlannedUnit, latest: RunRecord | None) -> str:
    """Return the state of a unit.

    current: the latest run has the result of the current recipe. ready: the store has it, the
        latest run has not. stale: the latest run has another. missing: there is none.
    """
    theirs = None if latest is None else latest.results.get(unit.name)
    if unit.published:
        return "current" if theirs == unit.key else "ready"
    return "missing" if theirs in (None, unit.key) else "stale"


def explain_unit(store: Store, name: str, overrides: Overrides) -> Explanation:
    """Return the state of a unit, and the reasons.

    Args:
        store: the store.
        name: as `match/stage/unit`.
        overrides: requested settings; empty = those of the latest run.

    Raises:
        InputError: no such unit.
    """
    match_id, _, unit_name = name.partition("/")
    match = open_match(store, match_id)
    latest = latest_run(store, match_id)
    asked = overrides or ({} if latest is None else latest.overrides)
    iteration = 1 if latest is None else latest.iteration
    planned = {unit.name: unit for unit in plan_run(store, match, asked, iteration=iteration)}
    if unit_name not in planned:
        raise InputError(
            name,
            expected=f"a unit of {match_id}: {', '.join(planned)}",
            found=repr(unit_name),
            todo="Write it as MATCH/STAGE/UNIT.",
        )
    unit = planned[unit_name]
    return Explanation(name, unit_state(unit, latest), unit.key, unit_reasons(store, unit, latest))


def unit_reasons(store: Store, unit: PlannedUnit, latest: RunRecord | None) -> tuple[str, ...]:
    """Return the reasons for the state in `unit_state`."""
    if latest is None or unit.name not in latest.results:
        return ("no run has computed it",)
    if latest.results[unit.name] == unit.key:
        lost = () if unit.published else ("its result was withdrawn or removed",)
        return (f"run {latest.run_id} has it", *lost)
    reasons = _why_differs(store, latest, unit.name, unit.recipe)
    return (f"since run {latest.run_id}:", *reasons)


def _why_differs(store: Store, run: RunRecord, unit: str, recipe: Recipe | None) -> tuple[str, ...]:
    """Return the differences between a recipe and that of a run's result."""
    before = _recipe(store, run, unit)
    if before is None or recipe is None:
        return ("its result was withdrawn or removed, and with it what it was made from",)
    return tuple(explain_difference(before, recipe))


def _recipe(store: Store, run: RunRecord, unit: str) -> Recipe | None:
    """Return the recipe of a run's result; None if the result was withdrawn or removed."""
    stage, _, name = unit.partition("/")
    place = (run.match_id, stage, name, run.results[unit])
    return store.manifest(*place).recipe if store.has(*place) else None


def _method_order(unit: str) -> tuple[int, str]:
    stage = unit.partition("/")[0]
    names = [each.name for each in METHOD]
    return (names.index(stage) if stage in names else len(names), unit)
