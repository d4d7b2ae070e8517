"""Run plan: the units of a run and their keys, decided before any work starts.

A unit's key is the digest of its recipe: inputs' keys, sources, settings, code, libraries. A result
is reused if and only if the store holds its key. Every run, and every question about what a run
would do, plans stage by stage with the `RunPlan` of this module.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Self

from data_contracts.run import RunRecord, WaitingUnit
from data_contracts.work import Recipe, Work
from flows.gates import Gatekeeper
from flows.left_out import left_out_cameras
from flows.method import METHOD
from flows.settings import Overrides, settings_of
from flows.stage import Match, Stage
from flows.usability import usable_limits
from worldpose.errors import StoreError, UsageError
from worldpose.sources import code_version
from worldpose.store.paths import ResultId
from worldpose.store.recipes import libraries, recipe_key
from worldpose.store.store import Store


@dataclass(frozen=True)
class PlannedUnit:
    """One unit of a run, in an iteration from 1; `key` is the digest of its recipe.

    It is published if the store held its result when it was planned; otherwise it is to run.
    """

    recipe: Recipe
    key: str
    published: bool
    iteration: int = 1

    @property
    def name(self) -> str:
        """Name as `stage/unit`."""
        return self.recipe.name

    def work(self, project: str, match: Match, run_id: str, seconds: float | None = None) -> Work:
        """Return the work order for this unit's task, with a time limit [s]."""
        return Work(
            project=project,
            folder=match.registration.folder,
            recipe=self.recipe,
            key=self.key,
            run_id=run_id,
            seconds=seconds,
            body_folder=None if match.body_folder is None else str(match.body_folder),
        )


@dataclass
class RunPlan:
    """Plan of a run, made stage by stage.

    A stage is planned from the results of the stages before it. A plan of a run in progress adds
    the results that exist (`add_results`); a plan made ahead (`plan_ahead`) adds those that the
    run will compute.

    Attributes:
        overrides: settings that differ from their defaults.
        results: `stage/unit` to key of the results that the run has, or will have.
        before: the same plan for the previous iteration; None in the first.
        gatekeeper: decides which results need review; None = every result passes.
        units: the units planned so far whose inputs are known.
        waiting: results that need review; later stages cannot use them.
        blocked: names, as `stage/unit`, of units with an input without a result, that wait for the
            decision which cameras are left out, or that need more cameras than are left.
        lacks_cameras: whether some are blocked because too many cameras are left out.
    """

    store: Store
    match: Match
    overrides: Overrides
    stages: tuple[Stage, ...] = METHOD
    iteration: int = 1
    results: dict[str, str] = field(default_factory=dict)
    before: Mapping[str, str] | None = None
    gatekeeper: Gatekeeper | None = None
    units: list[PlannedUnit] = field(default_factory=list)
    waiting: list[WaitingUnit] = field(default_factory=list)
    blocked: list[str] = field(default_factory=list)
    lacks_cameras: bool = False

    @classmethod
    def begin(
        cls,
        gatekeeper: Gatekeeper,
        stages: tuple[Stage, ...],
        overrides: Overrides,
        latest: RunRecord | None,
        iteration: int,
    ) -> Self:
        """Return the plan of a run of `stages` before its first stage.

        A part of the method continues the latest run's iteration, or begins the first one if the
        previous iteration's results are gone, as after an edit. A run from the method's first stage
        uses the previous iteration with its own settings. Any other run takes the latest run's
        results of earlier stages, stale or not, and the previous iteration that they come from.
        """
        store, match = gatekeeper.store, gatekeeper.match
        results: dict[str, str] = {}
        before: Mapping[str, str] | None = None
        earlier = METHOD[: METHOD.index(stages[0])]
        is_part = stages != METHOD
        if is_part:
            iteration = 1 if latest is None else latest.iteration
        if not earlier:
            before = results_before(store, match, overrides, iteration)
            if is_part and before is not None and lost_inputs(store, match, stages, before):
                iteration, before = 1, None
        elif latest is not None:
            names = {stage.name for stage in earlier}
            results = {
                name: key for name, key in latest.results.items() if name.partition("/")[0] in names
            }
            before = _inputs_from_before(store, match, latest) if iteration > 1 else None
        plan = cls(
            store=store,
            match=match,
            overrides=overrides,
            stages=stages,
            iteration=iteration,
            results=results,
            before=before,
            gatekeeper=gatekeeper,
        )
        for stage in earlier:
            plan.hold(stage, results)
        return plan

    @property
    def missing(self) -> list[PlannedUnit]:
        """The planned units to compute."""
        return [unit for unit in self.units if not unit.published]

    @property
    def usable_results(self) -> dict[str, str]:
        """The results that later stages can use."""
        return without_waiting(self.results, self.waiting)

    def plan_stage(self, stage: Stage) -> list[PlannedUnit]:
        """Plan a stage from the results so far; return its units whose inputs are known.

        The plan uses the cameras that no earlier result leaves out (`flows.left_out`).
        """
        before = self.before
        if before is None and stage.first_pass > 1:
            return []
        results = self.usable_results
        earlier = METHOD[: METHOD.index(stage)]
        left_out = left_out_cameras(self.store, self.match, earlier, results)
        match = self.match.without(left_out)
        lacks = bool(left_out) and len(match.folder.spec.static_cameras) < stage.min_cameras
        # Every result that can leave cameras out exists, and none waits.
        is_decided = not stage.min_cameras or all(
            f"{each.name}/{unit}" in results
            for each in earlier
            if each.leaves_out
            for unit in each.units(match)
        )
        if lacks or not is_decided:
            self.blocked += (f"{stage.name}/{unit}" for unit in stage.units(match))
            self.lacks_cameras |= is_decided
            return []
        settings = settings_of(stage, self.overrides)
        names, units = stage.units(match), []
        outside = stage.external_inputs(match, settings) if names else {}
        for unit in names:
            inputs = {name: results.get(name) for name in stage.inputs(match, unit)}
            if before is not None:
                inputs |= {name: results.get(name) for name in stage.late_inputs(match, unit)}
                inputs |= {
                    name: before.get(name) for name in stage.previous_pass_inputs(match, unit)
                }
            known = {name: key for name, key in inputs.items() if key is not None}
            if known.keys() != inputs.keys():
                self.blocked.append(f"{stage.name}/{unit}")
                continue
            # Not validated here: all values are ours, `recipe_key` refuses any that are not JSON,
            # and validating thousands of corrections one by one takes longer than all other steps.
            recipe = Recipe.model_construct(
                match_id=match.match_id,
                stage=stage.name,
                unit=unit,
                sources=stage.sources(match, unit) | outside,
                inputs=known,
                settings=settings.model_dump(mode="json"),
                code=code_version(stage.task_module),
                libraries=libraries(),
            )
            key = recipe_key(recipe)
            published = self.store.has(match.match_id, stage.name, unit, key)
            units.append(PlannedUnit(recipe, key, published, self.iteration))
        self.units += units
        return units

    def add_results(self, units: Iterable[PlannedUnit]) -> None:
        """Count the results of units as existing."""
        self.results |= {unit.name: unit.key for unit in units}

    def hold(self, stage: Stage, results: Mapping[str, str]) -> tuple[WaitingUnit, ...]:
        """Hold back the results of a stage that need review; return these."""
        held = (
            () if self.gatekeeper is None else self.gatekeeper.list_held_units(stage.name, results)
        )
        self.waiting += held
        return held

    def is_recorded_by(self, latest: RunRecord | None) -> bool:
        """Return whether the latest run's record equals that of a run made now."""
        if latest is None or latest.failed or latest.state == "failed" or self.missing:
            return False
        staged = {unit.name.partition("/")[0] for unit in self.units}
        ours, theirs = (
            {name: values for name, values in each.items() if name in staged}
            for each in (self.overrides, latest.overrides)
        )
        if ours != theirs:  # the next run is to know them
            return False
        if latest.usability.limits != usable_limits(self.match):  # it judges by them
            return False
        asked = {unit.request for unit in self.of_its_part(latest.waiting)}
        is_asked = {unit.request for unit in self.waiting} == asked
        return is_asked and self.results.items() <= latest.results.items()

    def of_its_part(self, waiting: Iterable[WaitingUnit]) -> list[WaitingUnit]:
        """Return the results that need review without those of stages after the plan's last."""
        part = {stage.name for stage in METHOD[: METHOD.index(self.stages[-1]) + 1]}
        return [unit for unit in waiting if unit.unit.partition("/")[0] in part]


def plan_ahead(
    gatekeeper: Gatekeeper,
    stages: tuple[Stage, ...],
    overrides: Overrides,
    latest: RunRecord | None,
    iteration: int,
) -> RunPlan:
    """Plan all stages of a run.

    The plan assumes that every unit succeeds and that every missing result passes its gate.
    `iteration` counts if the run does not continue the latest one.
    """
    plan = RunPlan.begin(gatekeeper, stages, overrides, latest, iteration)
    for stage in stages:
        units = plan.plan_stage(stage)
        if plan.blocked and not plan.waiting and not plan.lacks_cameras:
            raise UsageError(
                f"--from {stages[0].name}",
                expected=f"a latest run with all inputs of {plan.blocked[0]}",
                found=", ".join(sorted(plan.results)) or "no result of an earlier stage",
                todo="Run the match without --from first.",
            )
        plan.add_results(units)
        plan.hold(stage, {unit.name: unit.key for unit in units if unit.published})
    return plan


def plan_run(
    store: Store,
    match: Match,
    overrides: Overrides,
    stages: tuple[Stage, ...] = METHOD,
    iteration: int = 1,
) -> list[PlannedUnit]:
    """Plan all units of the method's first `stages`, as if every unit succeeded."""
    before = results_before(store, match, overrides, iteration)
    plan = RunPlan(store, match, overrides, stages, iteration, before=before)
    for stage in stages:
        plan.add_results(plan.plan_stage(stage))
    return plan.units


def results_before(
    store: Store, match: Match, overrides: Overrides, iteration: int
) -> dict[str, str] | None:
    """Return the previous iteration's results, `stage/unit` to key; None in the first iteration."""
    if iteration == 1:
        return None
    planned = plan_run(store, match, overrides, iteration=iteration - 1)
    return {unit.name: unit.key for unit in planned}


def lost_inputs(
    store: Store, match: Match, stages: tuple[Stage, ...], before: Mapping[str, str]
) -> list[str]:
    """Return the inputs of stages from the previous iteration that the store lacks."""
    used = {
        name
        for each in stages
        for unit in each.units(match)
        for name in each.previous_pass_inputs(match, unit)
    }
    return [
        name
        for name in sorted(used & before.keys())
        if not store.blobs.exists(
            ResultId.from_name(match.match_id, name, before[name]).manifest_path
        )
    ]


def without_waiting(results: Mapping[str, str], waiting: Iterable[WaitingUnit]) -> dict[str, str]:
    """Return the results that do not wait for review."""
    held = {unit.unit for unit in waiting}
    return {name: key for name, key in results.items() if name not in held}


def _inputs_from_before(store: Store, match: Match, latest: RunRecord) -> dict[str, str]:
    """Return the latest run's inputs from the previous iteration, read from its recipes."""
    before: dict[str, str] = {}
    for stage in METHOD:
        for unit in stage.units(match):
            name = f"{stage.name}/{unit}"
            taken = stage.previous_pass_inputs(match, unit)
            if not taken or name not in latest.results:
                continue
            try:
                manifest = store.manifest(match.match_id, stage.name, unit, latest.results[name])
            except StoreError:  # withdrawn: other recipes name them, else missing
                continue
            inputs = manifest.recipe.inputs
            before |= {each: inputs[each] for each in taken if each in inputs}
    return before
