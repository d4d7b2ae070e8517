"""What a run would do and where it would wait, decided before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from data_contracts.run import RunRecord, WaitingUnit
from flows.gatekeeping import Gatekeeper, passed
from flows.method import METHOD
from flows.planning import PlannedUnit, plan_run, plan_stage, results_before
from flows.settings import Overrides
from flows.stage import Stage


@dataclass(frozen=True)
class Outlook:
    """A run as it would be if every unit succeeded and every missing result passed its gate.

    Attributes:
        units: all units of its stages that are not behind a closed gate.
        standing: the results of the stages before.
        waiting: results that are there and wait for a person.
    """

    units: tuple[PlannedUnit, ...]
    standing: Mapping[str, str]
    waiting: tuple[WaitingUnit, ...]

    @property
    def missing(self) -> list[PlannedUnit]:
        """The units to compute."""
        return [unit for unit in self.units if not unit.published]

    @property
    def results(self) -> dict[str, str]:
        """`stage/unit` to key of all it would name."""
        return {**self.standing, **{unit.name: unit.key for unit in self.units}}

    def is_recorded_by(self, latest: RunRecord | None) -> bool:
        """Whether the latest run's record is that of a run made now."""
        if latest is None or latest.state not in ("complete", "waiting") or self.missing:
            return False
        is_asked = {unit.request for unit in self.waiting} == {u.request for u in latest.waiting}
        return is_asked and self.results.items() <= latest.results.items()


def look_ahead(
    gatekeeper: Gatekeeper,
    overrides: Overrides,
    stages: tuple[Stage, ...],
    standing: Mapping[str, str],
    iteration: int = 1,
) -> Outlook:
    """What a run of `stages` would do.

    Args:
        gatekeeper: with the store and the match.
        overrides: settings that differ from their defaults.
        stages: the stages to run.
        standing: results of the stages before them, as `stage/unit` to key.
        iteration: which, from 1.

    Raises:
        UsageError: `standing` lacks what the stages are made from.
    """
    store, match = gatekeeper.store, gatekeeper.match
    results = dict(standing)
    waiting = [
        unit
        for stage in METHOD[: METHOD.index(stages[0])]
        for unit in gatekeeper.held(stage.name, standing)
    ]
    before = results_before(store, match, overrides, iteration)
    units: list[PlannedUnit] = []
    for stage in stages:
        plan = plan_stage(store, match, stage, overrides, passed(results, waiting), before)
        if plan.blocked and not waiting:
            plan_run(store, match, overrides, stages, standing, iteration)  # says what is not there
        units += plan.units
        results |= {unit.name: unit.key for unit in plan.units}
        there = {unit.name: unit.key for unit in plan.units if unit.published}
        waiting += gatekeeper.held(stage.name, there)
    return Outlook(tuple(units), standing, tuple(waiting))
