"""Plan of a run: its units, and the gates where it would wait, before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from data_contracts.run import RunRecord, WaitingUnit
from flows.basis import Basis
from flows.gatekeeping import Gatekeeper, passed
from flows.method import METHOD
from flows.planning import PlannedUnit, plan_stage
from flows.settings import Overrides
from flows.stage import Stage
from worldpose.errors import UsageError


@dataclass(frozen=True)
class Outlook:
    """Run under the assumption that every unit succeeds and every missing result passes its gate.

    Attributes:
        units: all units of its stages that are not behind a closed gate.
        standing: the results of the stages before.
        waiting: existing results that need review.
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
        """`stage/unit` to key of all results of the run."""
        return {**self.standing, **{unit.name: unit.key for unit in self.units}}

    def is_recorded_by(self, latest: RunRecord | None) -> bool:
        """Return whether the latest run's record equals that of a run made now."""
        if latest is None or latest.failed or latest.state == "failed" or self.missing:
            return False
        is_asked = {unit.request for unit in self.waiting} == {u.request for u in latest.waiting}
        return is_asked and self.results.items() <= latest.results.items()


def look_ahead(
    gatekeeper: Gatekeeper,
    overrides: Overrides,
    stages: tuple[Stage, ...],
    basis: Basis,
) -> Outlook:
    """Plan a run of `stages`.

    Args:
        gatekeeper: with the store and the match.
        overrides: settings that differ from their defaults.
        stages: the stages to run.
        basis: existing results that it starts from.

    Raises:
        UsageError: `basis` lacks inputs of the stages.
    """
    store, match = gatekeeper.store, gatekeeper.match
    results = dict(basis.results)
    waiting = [
        unit
        for stage in METHOD[: METHOD.index(stages[0])]
        for unit in gatekeeper.held(stage.name, basis.results)
    ]
    units: list[PlannedUnit] = []
    lacks_cameras = False
    for stage in stages:
        plan = plan_stage(store, match, stage, overrides, passed(results, waiting), basis.before)
        lacks_cameras = lacks_cameras or plan.lacks_cameras
        if plan.blocked and not waiting and not lacks_cameras:
            raise UsageError(
                f"--from {stages[0].name}",
                expected=f"a latest run with all that {plan.blocked[0]} is made from",
                found=", ".join(sorted(results)) or "no result of an earlier stage",
                todo="Run without --from first.",
            )
        units += plan.units
        results |= {unit.name: unit.key for unit in plan.units}
        there = {unit.name: unit.key for unit in plan.units if unit.published}
        waiting += gatekeeper.held(stage.name, there)
    return Outlook(tuple(units), basis.results, tuple(waiting))
