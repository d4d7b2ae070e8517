"""Why results are what they are: comparing runs, explaining staleness."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from data_contracts.run import Recipe, RunRecord
from flows.planning import Overrides, plan_run
from flows.registering import open_match
from flows.run_record import latest_run
from worldpose.errors import UsageError
from worldpose.store import Store, explain_difference


@dataclass(frozen=True)
class UnitChange:
    """One unit in two runs.

    Attributes:
        unit: as `stage/unit`.
        state: same, changed, only in A, only in B.
        reasons: what of the recipe differs.
        figures: name, value in A, value in B of the figures that differ.
    """

    unit: str
    state: str
    reasons: tuple[str, ...]
    figures: tuple[tuple[str, float, float], ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON output."""
        return asdict(self)


@dataclass(frozen=True)
class Explanation:
    """Whether a unit is current, and why not."""

    unit: str
    state: str
    reasons: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON output."""
        return asdict(self)


def find_run(store: Store, name: str) -> RunRecord:
    """The run that a person means by `match/number`, or `match` for its latest.

    Raises:
        UsageError: no such run.
    """
    match_id, _, number = name.partition("/")
    runs = store.runs(match_id) if match_id in store.matches() else []
    run_id = number or (runs[-1] if runs else "")
    if run_id not in runs:
        raise UsageError(
            name,
            expected=f"MATCH/NUMBER; matches here: {', '.join(store.matches()) or '(none)'}",
            found=f"runs {', '.join(runs)}" if runs else "no run of that match",
            todo="See worldpose status.",
        )
    return store.run(match_id, run_id)


def run_difference(store: Store, a: RunRecord, b: RunRecord) -> list[UnitChange]:
    """How each unit differs between two runs, in the order of the method."""
    changes = []
    for unit in sorted(a.results.keys() | b.results.keys(), key=_method_order):
        if unit not in b.results:
            changes.append(UnitChange(unit, "only in A", (), ()))
        elif unit not in a.results:
            changes.append(UnitChange(unit, "only in B", (), ()))
        elif a.results[unit] == b.results[unit]:
            changes.append(UnitChange(unit, "same", (), ()))
        else:
            before, after = (_recipe(store, run, unit) for run in (a, b))
            old, new = (run.figures.get(unit, {}) for run in (a, b))
            figures = tuple(
                (name, old[name], new[name])
                for name in old
                if name in new and old[name] != new[name]
            )
            changes.append(
                UnitChange(unit, "changed", tuple(explain_difference(before, after)), figures)
            )
    return changes


def explain_unit(store: Store, name: str, overrides: Overrides) -> Explanation:
    """Whether the unit's result in the latest run is what a run would give now.

    Args:
        store: the store.
        name: as `match/stage/unit`.
        overrides: settings to ask for; empty = those of the latest run.

    Raises:
        UsageError: no such unit.
    """
    match_id, _, unit_name = name.partition("/")
    match = open_match(store, match_id)
    latest = latest_run(store, match_id)
    asked = overrides or ({} if latest is None else latest.overrides)
    planned = {unit.name: unit for unit in plan_run(store, match, asked)}
    if unit_name not in planned:
        raise UsageError(
            name,
            expected=f"a unit of {match_id}: {', '.join(planned)}",
            found=repr(unit_name),
            todo="Write it as MATCH/STAGE/UNIT.",
        )
    unit = planned[unit_name]
    if latest is None or unit_name not in latest.results:
        state = "published, but in no run" if unit.published else "never computed"
        return Explanation(name, state, ())
    if latest.results[unit_name] == unit.key:
        return Explanation(name, f"current (run {latest.run_id}, key {unit.key})", ())
    reasons = explain_difference(_recipe(store, latest, unit_name), unit.recipe)
    return Explanation(name, f"stale since run {latest.run_id}", tuple(reasons))


def _recipe(store: Store, run: RunRecord, unit: str) -> Recipe:
    stage, _, name = unit.partition("/")
    return store.manifest(run.match_id, stage, name, run.results[unit]).recipe


def _method_order(unit: str) -> tuple[int, str]:
    from flows.method import METHOD

    stage = unit.partition("/")[0]
    names = [each.name for each in METHOD]
    return (names.index(stage) if stage in names else len(names), unit)
