"""Run options: stages and settings, validated before anything starts."""

from __future__ import annotations

import json
from collections.abc import Mapping

from pydantic import JsonValue, ValidationError

from data_contracts.records import Record
from flows.method import METHOD
from flows.stage import Stage
from worldpose.errors import UsageError, unknown_name

Overrides = Mapping[str, Mapping[str, JsonValue]]
"""Stage to the settings that differ from their defaults."""


def selected_stages(from_stage: str | None, until_stage: str | None) -> tuple[Stage, ...]:
    """Return the stages between two stages, both included.

    Raises:
        UsageError: an unknown stage, or the first comes after the last.
    """
    names = [stage.name for stage in METHOD]
    first = 0 if from_stage is None else _place("--from", from_stage, names)
    last = len(names) - 1 if until_stage is None else _place("--until", until_stage, names)
    if first > last:
        raise UsageError(
            f"--from {from_stage} --until {until_stage}",
            expected=f"stages in the order {', '.join(names)}",
            found=f"{from_stage} after {until_stage}",
            todo="Swap the two stages.",
        )
    return METHOD[first : last + 1]


def parse_overrides(assignments: list[str], stages: tuple[Stage, ...] = METHOD) -> Overrides:
    """Parse settings given as `stage.name=value`; values are JSON, or else text.

    A setting of a stage that does not run would have no effect.

    Raises:
        UsageError: an unknown stage or setting, or an invalid value.
    """
    overrides: dict[str, dict[str, JsonValue]] = {}
    by_name = {stage.name: stage for stage in stages}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        stage_name, dot, field = name.partition(".")
        if not (equals and dot):
            raise UsageError(
                f"--set {assignment}",
                expected="stage.name=value",
                found=repr(assignment),
                todo="Write it as in: --set triangulation.min_views=3.",
            )
        _place(f"--set {assignment}", stage_name, list(by_name))
        value = parse_value(text)
        _place(f"--set {assignment}", field, list(by_name[stage_name].settings.model_fields))
        overrides.setdefault(stage_name, {})[field] = value
    for stage_name in overrides:
        settings_of(by_name[stage_name], overrides)
    return overrides


def parse_value(text: str) -> JsonValue:
    """Return the value of a setting, given as JSON or else as text."""
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):  # not JSON, or unclosed brackets
        return text
    return value


def settings_of(stage: Stage, overrides: Overrides) -> Record:
    """Return the stage's settings with `overrides` applied.

    Raises:
        UsageError: a value is invalid.
    """
    try:
        return stage.settings.model_validate(dict(overrides.get(stage.name, {})))
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(
            f"--set {stage.name}.{'.'.join(map(str, first['loc']))}",
            expected=first["msg"],
            found=repr(first["input"]),
            todo="List all settings: worldpose run MATCH --set list.",
        ) from None


def _place(where: str, name: str, names: list[str]) -> int:
    if name not in names:
        raise unknown_name(where, name, names)
    return names.index(name)
