"""Run status: which units of a match are stale, and why; and what differs between two runs.

An edit is a correction or a verdict, a changed file of the match folder, a setting, a detector's
weights, the code. All of them are in the units' recipes, so edits need no notification: the run
plan of now is compared with a match's latest run.
"""

from __future__ import annotations

import builtins
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from data_contracts.run import GatePolicy, RunRecord
from data_contracts.work import Recipe
from flows.gates import Gatekeeper
from flows.method import METHOD, unit_order
from flows.registering import find_registration, open_match
from flows.run_plan import PlannedUnit, plan_ahead, plan_run
from flows.run_record import latest_run
from flows.settings import Overrides, ResolvedSettings, resolve, selected_stages
from flows.stage import Match
from worldpose.errors import InputError, StoreError
from worldpose.store.recipes import RecipeDifference, recipe_differences
from worldpose.store.runs import LATEST
from worldpose.store.store import Run, Store

TEMPORARY_ERRORS: Final = frozenset(
    name
    for name, error in {**vars(builtins), "StoreError": StoreError}.items()
    if isinstance(error, type) and issubclass(error, StoreError | OSError)
)
"""Errors of a disk or a network, as run records name them; the next attempt can succeed."""


class UnitState(StrEnum):
    """State of a unit relative to a run."""

    CURRENT = "current"
    """The run has the result of the current recipe."""
    READY = "ready"
    """The store has that result, the run has not."""
    STALE = "stale"
    """The run has the result of another recipe; the unit is to be computed."""
    MISSING = "missing"
    """There is no result; the unit is to be computed."""


class Cause(StrEnum):
    """Why a unit's result is or is not that of a run, where no difference of recipes says it."""

    NOT_COMPUTED = "no run has computed it"
    WITHDRAWN = "its result was withdrawn or removed"
    WITHDRAWN_WITH_RECIPE = "its result was withdrawn or removed, and with it what it was made from"


Reason = Cause | RecipeDifference
"""Formatted by `str`."""


@dataclass(frozen=True)
class UnitStatus:
    """A planned unit compared with a run.

    `run_id` is the run that has a result of the unit, None if no run has one. The reasons are
    causes of the state, or differences of the recipe if the unit is stale.
    """

    planned: PlannedUnit
    state: UnitState
    run_id: str | None
    reasons: tuple[Reason, ...]

    @property
    def own_reasons(self) -> tuple[Reason, ...]:
        """Causes in this unit itself; empty if only its inputs changed."""
        inputs = {id(each) for each in self._input_changes}  # a source can have many differences
        return tuple(each for each in self.reasons if id(each) not in inputs)

    @property
    def changed_inputs(self) -> tuple[str, ...]:
        """Changed inputs, as `stage/unit`."""
        return tuple(each.name for each in self._input_changes)

    @property
    def _input_changes(self) -> list[RecipeDifference]:
        differences = (each for each in self.reasons if isinstance(each, RecipeDifference))
        return [each for each in differences if each.kind == "input"]

    def describe(self) -> tuple[str, ...]:
        """Return the reasons as lines for people."""
        lines = tuple(str(each) for each in self.reasons)
        if self.run_id is None:
            return lines
        is_recorded = self.state == UnitState.CURRENT or Cause.WITHDRAWN in self.reasons
        header = f"run {self.run_id} has it" if is_recorded else f"since run {self.run_id}:"
        return (header, *lines)


def unit_status(store: Store, unit: PlannedUnit, record: RunRecord | None) -> UnitStatus:
    """Compare a planned unit with a run; None is a match without a run."""
    state = unit_state(unit, record)
    if record is None or unit.name not in record.results:
        return UnitStatus(unit, state, None, (Cause.NOT_COMPUTED,))
    reasons: tuple[Reason, ...]
    if record.results[unit.name] == unit.key:
        reasons = () if unit.published else (Cause.WITHDRAWN,)
    else:
        reasons = recorded_differences(store, record, unit.name, unit.recipe)
    return UnitStatus(unit, state, record.run_id, reasons)


def unit_state(unit: PlannedUnit, record: RunRecord | None) -> UnitState:
    """Return the state of a planned unit relative to a run."""
    recorded = None if record is None else record.results.get(unit.name)
    if unit.published:
        return UnitState.CURRENT if recorded == unit.key else UnitState.READY
    return UnitState.MISSING if recorded in (None, unit.key) else UnitState.STALE


def plan_as_latest(
    store: Store, match: Match, latest: RunRecord | None, overrides: Overrides
) -> list[PlannedUnit]:
    """Plan the whole method with the settings and the iteration of the latest run.

    InputError if a setting of that run names a missing file.
    """
    found = resolve(match.layers, overrides)
    iteration = min(latest.iteration, last_iteration(latest, found)) if latest else 1
    return plan_run(store, match, found.overrides, iteration=iteration)


MAX_ITERATIONS: Final = 6
"""Maximum number of iterations that are `auto`."""


def last_iteration(latest: RunRecord, settings: ResolvedSettings) -> int:
    """Return the last iteration that these settings ask for after a run.

    `auto` asks for one more than the run kept: only one that is no better ends the iterations.
    """
    most = settings.general.iterations
    if most != "auto":
        return most
    return min(latest.iteration + (latest.state == "complete"), MAX_ITERATIONS)


def recorded_differences(
    store: Store, record: RunRecord, unit: str, recipe: Recipe | None
) -> tuple[Reason, ...]:
    """Return the differences of a recipe from that of a run's result."""
    before = recorded_recipe(store, record, unit)
    if before is None or recipe is None:
        return (Cause.WITHDRAWN_WITH_RECIPE,)
    return tuple(recipe_differences(before, recipe))


def recorded_recipe(store: Store, record: RunRecord, unit: str) -> Recipe | None:
    """Return the recipe of a run's result; None if the result was withdrawn or removed."""
    stage, _, name = unit.partition("/")
    if not store.has(record.match_id, stage, name, record.results[unit]):
        return None
    return Run(store, record).manifest(unit).recipe


@dataclass(frozen=True)
class RunStatus:
    """The stages that a match's latest run would recompute, to its last one; None = the last.

    `units` differ from the run, in order; `is_stale` is whether there is anything to do, even only
    to apply a verdict.
    """

    match: Match
    latest: RunRecord
    gates: GatePolicy
    until_stage: str | None
    units: tuple[UnitStatus, ...]
    is_stale: bool

    @property
    def to_compute(self) -> tuple[PlannedUnit, ...]:
        """Units to compute, each key once."""
        missing = [unit.planned for unit in self.units if unit.state != UnitState.READY]
        return tuple({unit.key: unit for unit in missing}.values())


def run_status(
    store: Store, match_id: str, settings: Overrides | None = None, *, retry: bool = False
) -> RunStatus | None:
    """Return what a match's latest run would recompute; None if the match never had a run.

    A failed unit with an unchanged recipe is skipped, and so are the units that depend on it,
    unless a disk or a network failed. `settings` go beyond those of the layers; `retry` retries all
    failed units. InputError if the match folder is invalid.
    """
    latest = latest_run(store, match_id)
    if latest is None:
        return None
    match = open_match(store, match_id)
    until = last_stage(match, latest)
    found = resolve(match.layers, settings)
    passes = last_iteration(latest, found) if until is None else 1  # a part of the method has one
    stages, gates = selected_stages(None, until), found.general.gates or latest.gates
    gatekeeper = Gatekeeper(store, match, gates)
    units: list[UnitStatus] = []
    lasting = (each for each in latest.failed if each.error not in TEMPORARY_ERRORS)
    hopeless = {} if retry else {each.unit: each.key for each in lasting}
    is_recorded = False
    for number in range(1, passes + 1):
        plan = plan_ahead(gatekeeper, stages, found.overrides, latest, number)
        is_kept = plan.iteration == latest.iteration
        record = latest if is_kept else _run_of_iteration(store, latest, plan.iteration)
        is_recorded = is_recorded or plan.is_recorded_by(latest)
        failing: set[str] = set()
        for unit in plan.units:
            if (unit.name, unit.key) in hopeless.items() or failing & unit.recipe.inputs.keys():
                failing.add(unit.name)
                continue
            state = unit_state(unit, record)
            # Only the results of other iterations count: their records can have other settings.
            if state != UnitState.CURRENT and (is_kept or state != UnitState.READY):
                units.append(unit_status(store, unit, record))
    is_settled = latest.state in ("complete", "waiting")
    return RunStatus(
        match=match,
        latest=latest,
        gates=gates,
        until_stage=until,
        units=tuple(units),
        is_stale=bool(units) or (is_settled and not is_recorded),
    )


def last_stage(match: Match, latest: RunRecord) -> str | None:
    """Return the last stage of the run; None = the method's last."""
    units = [*latest.results, *latest.blocked, *(failure.unit for failure in latest.failed)]
    planned = {name.partition("/")[0] for name in units}
    stages = [stage for stage in METHOD if stage.units(match)]
    reached = [stage for stage in stages if stage.name in planned] or stages
    return None if reached[-1] is stages[-1] else reached[-1].name


def _run_of_iteration(store: Store, latest: RunRecord, number: int) -> RunRecord | None:
    """Return the newest run of an earlier iteration, preferably with the latest run's settings."""
    records = [store.run(latest.match_id, run_id) for run_id in store.runs(latest.match_id)]
    passes = [record for record in reversed(records) if record.iteration == number]
    same = (record for record in passes if record.overrides == latest.overrides)
    return next(same, passes[0] if passes else None)


@dataclass(frozen=True)
class UnitChange:
    """Change of one unit between two runs: same, changed, only in A or only in B.

    The reasons are differences of the recipes; figures are name, value in A and value in B of the
    metrics that differ.
    """

    unit: str
    state: str
    reasons: tuple[str, ...]
    figures: tuple[tuple[str, float, float], ...]


def find_run(store: Store, name: str) -> RunRecord:
    """Return the run named by `match/number` or `match/name`, or `match` for its latest."""
    match_id, _, number = name.partition("/")
    return store.run(find_registration(store, match_id).spec.match_id, number or LATEST)


def run_difference(store: Store, a: RunRecord, b: RunRecord) -> list[UnitChange]:
    """Compare each unit between two runs, in the order of the method."""
    changes = []
    for unit in sorted(a.results.keys() | b.results.keys(), key=unit_order):
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


def explain_unit(store: Store, name: str, overrides: Overrides) -> dict[str, Any]:
    """Return a unit's name, state (`UnitState`), current key, and the reasons as lines for people.

    The unit is `match/stage/unit`; the overrides go beyond the settings of the layers.
    """
    match_id, _, unit_name = name.partition("/")
    match = open_match(store, match_id)
    latest = latest_run(store, match_id)
    planned = {unit.name: unit for unit in plan_as_latest(store, match, latest, overrides)}
    if unit_name not in planned:
        raise InputError(
            name,
            expected=f"a unit of {match_id}: {', '.join(planned)}",
            found=repr(unit_name),
            todo="Write it as MATCH/STAGE/UNIT.",
        )
    status = unit_status(store, planned[unit_name], latest)
    failures = tuple(
        f"run {match_id}/{latest.run_id} failed with the same input and settings: {each.message}"
        for each in (latest.failed if latest else ())
        if latest is not None and each.unit == unit_name and each.key == status.planned.key
    )
    found = {"unit": name, "state": status.state.value, "key": status.planned.key}
    return {**found, "reasons": failures or status.describe()}
