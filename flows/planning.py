"""Planning of a run: keys of all units, computed before any work starts.

A unit's key is the digest of its recipe: inputs' keys, sources, settings, code, libraries. A result
is reused if and only if the store holds its key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from data_contracts.work import Recipe, Work
from flows.left_out import left_out_cameras
from flows.method import METHOD
from flows.settings import Overrides, settings_of
from flows.stage import Match, Stage
from worldpose.store import Store, code_version, libraries, recipe_key


@dataclass(frozen=True)
class PlannedUnit:
    """One unit with its recipe, its key and whether its result exists."""

    recipe: Recipe
    key: str
    published: bool

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
        )


@dataclass(frozen=True)
class StagePlan:
    """Planned units of a stage.

    Attributes:
        units: units with known inputs.
        blocked: names, as `stage/unit`, of units with an input without a result, that wait for the
            decision which cameras are left out, or that need more cameras than are left.
        lacks_cameras: whether they are blocked because too many cameras are left out.
    """

    units: tuple[PlannedUnit, ...]
    blocked: tuple[str, ...]
    lacks_cameras: bool = False


def plan_stage(
    store: Store,
    match: Match,
    stage: Stage,
    overrides: Overrides,
    results: Mapping[str, str],
    before: Mapping[str, str] | None = None,
) -> StagePlan:
    """Plan the units of a stage.

    The plan uses the cameras that no earlier result leaves out (`flows.left_out`).

    Args:
        store: store with existing results.
        match: the match, with all its cameras.
        stage: the stage to plan.
        overrides: settings that differ from their defaults.
        results: `stage/unit` to key of results that earlier stages have, or will have.
        before: the same for the previous iteration; None in the first.
    """
    if before is None and stage.first_pass > 1:
        return StagePlan((), ())
    earlier = METHOD[: METHOD.index(stage)]
    left_out = left_out_cameras(store, match, earlier, results)
    match = match.without(left_out)
    if stage.min_cameras and not _cameras_are_decided(match, earlier, results):
        return StagePlan((), tuple(f"{stage.name}/{unit}" for unit in stage.units(match)))
    if left_out and len(match.folder.spec.static_cameras) < stage.min_cameras:
        blocked_units = tuple(f"{stage.name}/{unit}" for unit in stage.units(match))
        return StagePlan((), blocked_units, lacks_cameras=True)
    settings = settings_of(stage, overrides)
    outside = stage.external_inputs(settings)
    units, blocked = [], []
    for unit in stage.units(match):
        inputs = {name: results.get(name) for name in stage.inputs(match, unit)}
        if before is not None:
            inputs |= {name: results.get(name) for name in stage.late_inputs(match, unit)}
            inputs |= {name: before.get(name) for name in stage.previous_pass_inputs(match, unit)}
        known = {name: key for name, key in inputs.items() if key is not None}
        if known.keys() != inputs.keys():
            blocked.append(f"{stage.name}/{unit}")
            continue
        # Not validated here: all values are ours, `recipe_key` refuses values that are not JSON,
        # and validating thousands of corrections one by one takes longer than all other steps.
        recipe = Recipe.model_construct(
            match_id=match.match_id,
            stage=stage.name,
            unit=unit,
            sources=stage.sources(match, unit) | outside,
            inputs=known,
            settings=settings.model_dump(mode="json"),
            code=code_version(f"tasks.{stage.name}"),
            libraries=libraries(),
        )
        key = recipe_key(recipe)
        published = store.has(match.match_id, stage.name, unit, key)
        units.append(PlannedUnit(recipe, key, published))
    return StagePlan(tuple(units), tuple(blocked))


def _cameras_are_decided(
    match: Match, stages: tuple[Stage, ...], results: Mapping[str, str]
) -> bool:
    """Return whether every result that can leave cameras out exists, and none waits."""
    judging = (stage for stage in stages if stage.leaves_out)
    return all(
        f"{stage.name}/{unit}" in results for stage in judging for unit in stage.units(match)
    )


def plan_run(
    store: Store,
    match: Match,
    overrides: Overrides,
    stages: tuple[Stage, ...] = METHOD,
    iteration: int = 1,
) -> list[PlannedUnit]:
    """Plan all units of the method's first `stages`, as if every unit succeeded.

    Args:
        store: store with existing results.
        match: the match.
        overrides: settings that differ from their defaults.
        stages: the stages to plan, from the first.
        iteration: iteration number, from 1.
    """
    planned: list[PlannedUnit] = []
    results: dict[str, str] = {}
    before = results_before(store, match, overrides, iteration)
    for stage in stages:
        plan = plan_stage(store, match, stage, overrides, results, before)
        results |= {unit.name: unit.key for unit in plan.units}
        planned += plan.units
    return planned


def results_before(
    store: Store, match: Match, overrides: Overrides, iteration: int
) -> dict[str, str] | None:
    """Return the previous iteration's results, `stage/unit` to key; None in the first iteration."""
    if iteration == 1:
        return None
    planned = plan_run(store, match, overrides, iteration=iteration - 1)
    return {unit.name: unit.key for unit in planned}
