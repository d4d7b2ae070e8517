"""What an edit has touched: what a match's latest run would compute anew, and why.

An edit is a correction or a verdict, a changed file of the match folder, a setting, a detector's
weights, the code. All of them are in the units' recipes, so that nobody has to tell of an edit.
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
from flows.run_record import latest_run
from flows.settings import Overrides, selected_stages
from flows.stage import Match
from worldpose.errors import InputError, StoreError
from worldpose.store import Store

_INPUT: Final = "input "
"""How a line about an input begins (`explain_difference`)."""


@dataclass(frozen=True)
class TouchedUnit:
    """One unit that the latest run does not have as a run would give it now.

    Attributes:
        planned: with its recipe as it is now.
        iteration: of which pass over the method.
        state: stale or missing, to be computed; ready: the store has it (`unit_state`).
        reasons: what of its recipe is another.
    """

    planned: PlannedUnit
    iteration: int
    state: str
    reasons: tuple[str, ...]

    @property
    def unit(self) -> str:
        """As `stage/unit`."""
        return self.planned.name

    @property
    def own_reasons(self) -> tuple[str, ...]:
        """What is another in this unit itself; none where only what it is made from is."""
        return tuple(line for line in self.reasons if not line.startswith(("since run", _INPUT)))

    @property
    def changed_inputs(self) -> tuple[str, ...]:
        """What it is made from and is another, as `stage/unit`."""
        inputs = (line for line in self.reasons if line.startswith(_INPUT))
        return tuple(line.removeprefix(_INPUT).partition(":")[0] for line in inputs)


@dataclass(frozen=True)
class Touched:
    """One match as a new run would find it.

    Attributes:
        match: with everything that people said of it until now.
        latest: the run that stands.
        settings: those of that run, and what was asked for beyond.
        until_stage: where that run ended; None = with the method.
        units: those that are no longer as the run has them, in order.
        is_touched: whether there is anything to do, were it only a verdict to be heeded.
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
    """What a match's latest run would do anew; None where the match never had one.

    A unit that failed is left at that while its recipe is the same, and with it what would be made
    from it, except where a disk or a network failed.

    Args:
        store: the project.
        match_id: a registered match.
        settings: what to ask for beyond the settings of the latest run.
        retry: try again whatever failed.

    Raises:
        InputError: the match folder is not as it must be.
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
        # Of the passes before, only their results count: their records may be of other settings.
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
    """Settings with further ones over them."""
    names = before.keys() | further.keys()
    return {name: {**before.get(name, {}), **further.get(name, {})} for name in sorted(names)}


def _units(
    store: Store,
    outlook: Outlook,
    standing: RunRecord | None,
    hopeless: Mapping[str, str | None],
    iteration: int,
) -> Iterator[TouchedUnit]:
    """The units that are not as a run has them, but for those that would fail again."""
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
    """The stage that the run was to end with; None = the last there was."""
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
    """The newest run of an earlier pass over the method, of the latest run's settings if any is."""
    records = [store.run(latest.match_id, run_id) for run_id in store.runs(latest.match_id)]
    passes = [record for record in reversed(records) if record.iteration == number]
    same = (record for record in passes if record.overrides == latest.overrides)
    return next(same, passes[0] if passes else None)


def _may_pass(failure: UnitFailure) -> bool:
    """Whether a recorded failure was a disk's or a network's, and may be gone next time."""
    kind = getattr(builtins, failure.error, None)
    is_system = isinstance(kind, type) and issubclass(kind, OSError)
    return is_system or failure.error == StoreError.__name__
