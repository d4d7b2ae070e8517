"""Stale results of a match: units that its latest run would recompute, and why.

An edit is a correction or a verdict, a changed file of the match folder, a setting, a detector's
weights, the code. All of them are in the units' recipes, so edits need no notification.
"""

from __future__ import annotations

import builtins
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from pydantic import JsonValue

from data_contracts.run import RunRecord, UnitFailure
from flows.basis import basis_of
from flows.gatekeeping import Gatekeeper
from flows.lineage import unit_reasons, unit_state
from flows.method import METHOD
from flows.outlook import Outlook, look_ahead
from flows.planning import PlannedUnit
from flows.registering import open_match
from flows.renames import rename_settings
from flows.run_record import latest_run
from flows.settings import Overrides, selected_stages
from flows.stage import Match
from worldpose.errors import InputError, StoreError
from worldpose.store import Store

_INPUT: Final = "input "
"""Prefix of a line about an input (`explain_difference`)."""


@dataclass(frozen=True)
class TouchedUnit:
    """A unit whose current result is not in the latest run.

    Attributes:
        planned: with its current recipe.
        iteration: its iteration number.
        state: stale or missing, to be computed; ready: the store has it (`unit_state`).
        reasons: differences of its recipe.
    """

    planned: PlannedUnit
    iteration: int
    state: str
    reasons: tuple[str, ...]

    @property
    def unit(self) -> str:
        """Name as `stage/unit`."""
        return self.planned.name

    @property
    def own_reasons(self) -> tuple[str, ...]:
        """Differences in this unit itself; empty if only its inputs changed."""
        return tuple(line for line in self.reasons if not line.startswith(("since run", _INPUT)))

    @property
    def changed_inputs(self) -> tuple[str, ...]:
        """Changed inputs, as `stage/unit`."""
        inputs = (line for line in self.reasons if line.startswith(_INPUT))
        return tuple(line.removeprefix(_INPUT).partition(":")[0] for line in inputs)


@dataclass(frozen=True)
class Touched:
    """Stale results of one match.

    Attributes:
        match: with all current corrections and verdicts.
        latest: the current run.
        settings: settings of that run, and further requested ones.
        until_stage: last stage of that run; None = the method's last.
        units: units that differ from the run, in order.
        is_touched: whether there is anything to do, even only to apply a verdict.
    """

    match: Match
    latest: RunRecord
    settings: Overrides
    until_stage: str | None
    units: tuple[TouchedUnit, ...]
    is_touched: bool

    @property
    def to_compute(self) -> tuple[PlannedUnit, ...]:
        """Units to compute, each key once."""
        missing = {unit.planned.key: unit.planned for unit in self.units if unit.state != "ready"}
        return tuple(missing.values())


def find_touched(
    store: Store, match_id: str, settings: Overrides | None = None, *, retry: bool = False
) -> Touched | None:
    """Find what a match's latest run would recompute; None if the match never had a run.

    A failed unit with an unchanged recipe is skipped, and so are the units that depend on it,
    unless a disk or a network failed.

    Args:
        store: the project.
        match_id: a registered match.
        settings: requested settings beyond those of the latest run.
        retry: retry all failed units.

    Raises:
        InputError: the match folder is invalid.
    """
    latest = latest_run(store, match_id)
    if latest is None:
        return None
    match = open_match(store, match_id)
    asked = merged(latest.overrides, settings or {})
    until = _until(match, latest)
    stages = selected_stages(None, until)
    gatekeeper = Gatekeeper(store, match, latest.gates)
    units: list[TouchedUnit] = []
    hopeless = {} if retry else {f.unit: f.key for f in latest.failed if not _may_pass(f)}
    for number in range(1, latest.iteration + 1):
        basis = basis_of(store, match, stages, asked, latest, number)
        outlook = look_ahead(gatekeeper, asked, stages, basis)
        is_last = number == latest.iteration
        standing = latest if is_last else _pass(store, latest, number)
        found = _units(store, outlook, standing, hopeless, number)
        # Only the results of earlier iterations count: their records can have other settings.
        units += [unit for unit in found if is_last or unit.state != "ready"]
    settled = latest.state in ("complete", "waiting")
    return Touched(
        match=match,
        latest=latest,
        settings=asked,
        until_stage=until,
        units=tuple(units),
        is_touched=bool(units) or (settled and not outlook.is_recorded_by(latest)),
    )


def merged(before: Overrides, further: Overrides) -> dict[str, dict[str, JsonValue]]:
    """Return settings overridden by further ones."""
    names = before.keys() | further.keys()
    return {name: {**before.get(name, {}), **further.get(name, {})} for name in sorted(names)}


def _units(
    store: Store,
    outlook: Outlook,
    standing: RunRecord | None,
    hopeless: Mapping[str, str | None],
    iteration: int,
) -> Iterator[TouchedUnit]:
    """Yield the units that differ from a run, except those that would fail again."""
    failing: set[str] = set()
    for unit in outlook.units:
        if (unit.name, unit.key) in hopeless.items() or failing & unit.recipe.inputs.keys():
            failing.add(unit.name)
            continue
        state = unit_state(unit, standing)
        if state != "current":
            reasons = unit_reasons(store, unit, standing)
            yield TouchedUnit(unit, iteration, state, reasons)


def _until(match: Match, latest: RunRecord) -> str | None:
    """Return the last stage of the run; None = the method's last."""
    planned = {*latest.results, *latest.blocked, *(failure.unit for failure in latest.failed)}
    known = [stage for stage in METHOD if stage.name in latest.settings and stage.units(match)]
    reached = [stage for stage in known if any(_is_of(name, stage.name) for name in planned)]
    if not reached:
        raise InputError(
            f"run {latest.run_id} of {match.match_id}",
            expected="results of a stage that this version knows",
            found=", ".join(sorted(planned)) or "none",
            todo=f"Run: worldpose run {match.match_id}.",
        )
    return None if reached[-1] is known[-1] else reached[-1].name


def _is_of(unit: str, stage: str) -> bool:
    return unit.partition("/")[0] == stage


def _pass(store: Store, latest: RunRecord, number: int) -> RunRecord | None:
    """Return the newest run of an earlier iteration, preferably with the latest run's settings."""
    records = [store.run(latest.match_id, run_id) for run_id in store.runs(latest.match_id)]
    passes = [record for record in reversed(records) if record.iteration == number]
    same = (record for record in passes if rename_settings(record.overrides) == latest.overrides)
    return next(same, passes[0] if passes else None)


def _may_pass(failure: UnitFailure) -> bool:
    """Return whether a recorded failure was a disk's or a network's, and can be temporary."""
    kind = getattr(builtins, failure.error, None)
    is_system = isinstance(kind, type) and issubclass(kind, OSError)
    return is_system or failure.error == StoreError.__name__
