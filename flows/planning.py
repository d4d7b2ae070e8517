"""What a run must do: keys of all units, decided before any work starts.

A unit's key is the digest of its recipe: inputs' keys, sources, settings, code, libraries. Whatever
key the store already holds is reused; nothing else is ever skipped.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache

from pydantic import JsonValue, ValidationError

from data_contracts.records import Record
from data_contracts.run import Recipe, Work
from flows.method import METHOD
from flows.stage import Match, Stage
from worldpose.errors import UsageError
from worldpose.store import Store, code_version, key_of, libraries

Overrides = Mapping[str, Mapping[str, JsonValue]]
"""Stage to the settings that differ from their defaults."""


@dataclass(frozen=True)
class PlannedUnit:
    """One unit with its recipe, its key and whether its result exists."""

    recipe: Recipe
    key: str
    published: bool

    @property
    def name(self) -> str:
        """As `stage/unit`."""
        return self.recipe.name

    def work(self, project: str, match: Match, run_id: str) -> Work:
        """This unit as a task takes it."""
        return Work(
            project=project,
            folder=match.registration.folder,
            recipe=self.recipe,
            key=self.key,
            run_id=run_id,
        )


def plan_stage(
    store: Store, match: Match, stage: Stage, overrides: Overrides, results: Mapping[str, str]
) -> list[PlannedUnit]:
    """The stage's units whose inputs are all known.

    Args:
        store: where results are looked for.
        match: the match.
        stage: the stage to plan.
        overrides: settings that differ from their defaults.
        results: `stage/unit` to key of what earlier stages have, or will have, computed.
    """
    settings = settings_of(stage, overrides).model_dump(mode="json")
    planned = []
    for unit in stage.units(match):
        inputs = stage.inputs(match, unit)
        if not all(name in results for name in inputs):
            continue
        recipe = Recipe(
            match_id=match.match_id,
            stage=stage.name,
            unit=unit,
            sources=stage.sources(match, unit),
            inputs={name: results[name] for name in inputs},
            settings=settings,
            code=_code_of(stage.name),
            libraries=libraries(),
        )
        key = key_of(recipe)
        published = store.has(match.match_id, stage.name, unit, key)
        planned.append(PlannedUnit(recipe, key, published))
    return planned


def plan_run(
    store: Store,
    match: Match,
    overrides: Overrides,
    stages: tuple[Stage, ...] = METHOD,
    standing: Mapping[str, str] | None = None,
) -> list[PlannedUnit]:
    """All units of `stages` in order, as they would be if every one succeeded.

    Args:
        store: where results are looked for.
        match: the match.
        overrides: settings that differ from their defaults.
        stages: the stages to plan.
        standing: results of the stages before them, as `stage/unit` to key.
    """
    planned: list[PlannedUnit] = []
    results = dict(standing or {})
    for stage in stages:
        units = plan_stage(store, match, stage, overrides, results)
        results |= {unit.name: unit.key for unit in units}
        planned += units
    return planned


def selected_stages(from_stage: str | None, until_stage: str | None) -> tuple[Stage, ...]:
    """The stages from one to another, both included.

    Raises:
        UsageError: no such stage, or the first comes after the last.
    """
    names = [stage.name for stage in METHOD]
    first = 0 if from_stage is None else _place("--from", from_stage, names)
    last = len(names) - 1 if until_stage is None else _place("--until", until_stage, names)
    if first > last:
        raise UsageError(
            f"--from {from_stage} --until {until_stage}",
            expected=f"stages in the order {', '.join(names)}",
            found=f"{from_stage} after {until_stage}",
            todo="Swap them.",
        )
    return METHOD[first : last + 1]


def parse_overrides(assignments: list[str]) -> dict[str, dict[str, JsonValue]]:
    """Settings given as `stage.name=value`; values are JSON, or else text.

    Raises:
        UsageError: no such stage or setting, or a value that does not fit it.
    """
    overrides: dict[str, dict[str, JsonValue]] = {}
    stages = {stage.name: stage for stage in METHOD}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        stage_name, dot, field = name.partition(".")
        if not (equals and dot):
            raise UsageError(
                f"--set {assignment}",
                expected="stage.name=value",
                found=repr(assignment),
                todo="For example: --set triangulation.min_views=3.",
            )
        _place(f"--set {assignment}", stage_name, list(stages))
        _place(f"--set {assignment}", field, list(stages[stage_name].settings.model_fields))
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        overrides.setdefault(stage_name, {})[field] = value
    for stage_name in overrides:
        settings_of(stages[stage_name], overrides)
    return overrides


def settings_of(stage: Stage, overrides: Overrides) -> Record:
    """The stage's settings with `overrides` applied.

    Raises:
        UsageError: a value does not fit.
    """
    try:
        return stage.settings.model_validate(dict(overrides.get(stage.name, {})))
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(
            f"--set {stage.name}.{'.'.join(map(str, first['loc']))}",
            expected=first["msg"],
            found=repr(first["input"]),
            todo=f"The settings of {stage.name} are described in docs/method.md.",
        ) from None


@cache
def _code_of(stage: str) -> dict[str, str]:
    return code_version(f"tasks.{stage}")


def _place(where: str, name: str, names: list[str]) -> int:
    if name in names:
        return names.index(name)
    close = get_close_matches(name, names, n=1)
    raise UsageError(
        where,
        expected=f"one of {', '.join(names) or '(this stage has no settings)'}",
        found=repr(name),
        todo=f"Did you mean {close[0]!r}?" if close else "Choose one of these.",
    )
