"""Settings of runs: stages and values, validated before anything starts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Final

from pydantic import JsonValue, ValidationError

from data_contracts.records import Record, field_docstrings
from data_contracts.settings import RunSettings
from flows.layers import (
    MATCHES,
    VENUES,
    Layer,
    check_general,
    merge_general,
    read_layer,
    write_layer,
)
from flows.method import METHOD
from flows.stage import Stage
from worldpose.detection.models import LIBRARIES
from worldpose.errors import InputError, UsageError, unknown_name
from worldpose.store.store import Store

Overrides = Mapping[str, Mapping[str, JsonValue]]
"""Stage to the settings that differ from their defaults."""


def known_settings() -> dict[str, dict[str, JsonValue]]:
    """Return the `default` of all settings and what they are `about`, by name."""
    told = {
        f"{prefix}{name}": " ".join(text.split())
        for prefix, record in _records().items()
        for name, text in field_docstrings(record).items()
    }
    return {n: {"default": value, "about": told.get(n, "")} for n, value in _built_in().items()}


def _records() -> dict[str, type[Record]]:
    """Return the records of settings by the beginning of their names."""
    return {"": RunSettings, **{f"{stage.name}.": stage.settings for stage in METHOD}}


@cache
def _built_in() -> Mapping[str, JsonValue]:
    return {
        f"{prefix}{name}": value
        for prefix, record in _records().items()
        for name, value in record().model_dump(mode="json").items()
    }


@dataclass(frozen=True)
class ResolvedSettings:
    """Settings of a match's next run, of which `general` are not of a stage.

    Attributes:
        values: name to value of everything that a layer states.
        origins: name to the layer that states the value.
    """

    values: Mapping[str, JsonValue]
    origins: Mapping[str, Layer]
    general: RunSettings

    @property
    def overrides(self) -> dict[str, dict[str, JsonValue]]:
        """Stage to its stated settings."""
        return by_stage(self.values)

    def differences(self) -> dict[str, dict[str, JsonValue]]:
        """Return value, default and origin of each setting that differs from its default."""
        return {
            name: {"value": value, "default": default, "from": self.origins[name].origin}
            for name, value in sorted(self.values.items())
            for default in [_built_in()[name]]
            if value != default
        }


def resolve(layers: Iterable[Layer], stated: Overrides | None = None) -> ResolvedSettings:
    """Return the settings that layers, and over them a command line, give to a run.

    Every door (command, page, inbox, schedule, reprocess) and every question about a next run takes
    its settings from here. InputError if a file states an unknown name or an invalid value, or a
    venue has no file; UsageError if the command line does.
    """
    command = Layer("command line", "--set", flatten(stated or {}))
    given = [*layers, command]
    for layer in given:
        if layer.name.startswith(VENUES) and not layer.revision:
            name = layer.name.partition("/")[2]
            raise InputError(
                f"venue {name}",
                expected=f"its settings in {layer.file}",
                found="nothing",
                todo=f"Correct the name, or add it: worldpose settings --venue {name} --add.",
            )
        for name in layer.values:
            require_known(name, f"{layer.file}: {name}")
    origins = {name: layer for layer in given for name in layer.values}
    values = {name: layer.values[name] for name, layer in origins.items()}
    overrides = by_stage(values)
    for stage in METHOD:
        try:
            settings_of(stage, overrides)
        except UsageError as error:
            name = ".".join(error.where.removeprefix("--set ").split(".")[:2])
            of_stage = (it for each, it in origins.items() if each.startswith(f"{stage.name}."))
            layer = origins.get(name) or next(of_stage)
            if layer is command:
                raise
            raise InputError(
                f"{layer.file}: {name}", expected=error.expected, found=error.found, todo=LIST
            ) from None
    return ResolvedSettings(values, origins, merge_general(given))


def require_known(name: str, where: str) -> None:
    """Check the name of a setting; the error suggests a similar one, not all 190."""
    if name not in _built_in():
        close = get_close_matches(name, _built_in(), n=1)
        raise UsageError(
            where,
            expected="the name of a setting",
            found=repr(name),
            todo=" ".join([*(f"Did you mean {each!r}?" for each in close), LIST]),
        )


def save_layer(
    store: Store, layers: Iterable[Layer], name: str, values: Mapping[str, JsonValue]
) -> None:
    """Write a layer, if it is valid over those before it.

    InputError, and nothing is written, if a name is unknown, or a value is invalid.
    """
    layer = replace(read_layer(store, name), values=values, revision="new")
    check_general(name, layer.file, values)
    given = [each for each in layers if each.name != name]
    if name.startswith(MATCHES):  # of the venue that it names now
        venues = [each.values["venue"] for each in (*given, layer) if "venue" in each.values]
        given = [each for each in given if not each.name.startswith(VENUES)]
        given += [read_layer(store, f"{VENUES}/{venue}") for venue in venues[-1:] if venue]
    resolve([*given, layer])
    write_layer(store, name, values)


def flatten(overrides: Overrides) -> dict[str, JsonValue]:
    """Return settings of stages by `stage.setting`."""
    return {
        f"{stage}.{name}": value
        for stage, values in overrides.items()
        for name, value in values.items()
    }


def by_stage(values: Mapping[str, JsonValue]) -> dict[str, dict[str, JsonValue]]:
    """Return the settings of stages among named values, by stage."""
    found: dict[str, dict[str, JsonValue]] = {}
    for name in sorted(values):
        stage, dot, setting = name.partition(".")
        if dot:
            found.setdefault(stage, {})[setting] = values[name]
    return found


DEFAULT_MINUTES: Final = 360.0
"""Default limit of a stage [min]; the longest unit so far took a tenth of it."""

TimeLimits = Mapping[str, float]
"""Stage to the time limit of each of its units [min]."""

LIST = "List all settings: worldpose settings --list."


def selected_stages(from_stage: str | None, until_stage: str | None) -> tuple[Stage, ...]:
    """Return the stages between two stages, both included."""
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
        value = parse_value(text, name)
        _place(f"--set {assignment}", field, list(by_name[stage_name].settings.model_fields))
        overrides.setdefault(stage_name, {})[field] = value
    for stage_name in overrides:
        settings_of(by_name[stage_name], overrides)
    return overrides


def parse_value(text: str, name: str = "") -> JsonValue:
    """Return the value of a setting, given as JSON or else as text.

    Venues can be numbers; files of weights of `detection` get absolute paths.
    """
    try:
        value: JsonValue = json.loads(text)
    except (ValueError, RecursionError):  # not JSON, or unclosed brackets
        value = text
    if name.startswith("detection."):
        return _absolute_weights(value)
    return text if name == "venue" and isinstance(value, int | float) else value


def _absolute_weights(value: JsonValue) -> JsonValue:
    """Return `onnx:FILE` and its like with absolute paths: other processes run elsewhere."""
    if isinstance(value, list):
        return [_absolute_weights(each) for each in value]
    kind, colon, path = value.partition(":") if isinstance(value, str) else ("", "", "")
    if path and kind.partition("-")[0] in LIBRARIES:
        return f"{kind}{colon}{Path(path).expanduser().absolute()}"
    return value


def as_text(value: JsonValue) -> str:
    """Return a value as `parse_value` reads it."""
    return value if isinstance(value, str) else json.dumps(value)


def settings_of(stage: Stage, overrides: Overrides) -> Record:
    """Return the stage's settings with `overrides` applied."""
    given = dict(overrides.get(stage.name, {}))
    try:
        settings = stage.settings.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(
            f"--set {stage.name}.{'.'.join(map(str, first['loc']))}",
            expected=first["msg"],
            found=repr(first["input"]),
            todo=LIST,
        ) from None
    for name, value in given.items():
        if _count_truths(value) > _count_truths(getattr(settings, name)):  # read as 1 or 0
            raise UsageError(
                f"--set {stage.name}.{name}",
                expected="a number" if isinstance(value, bool) else "numbers",
                found=as_text(value),
                todo=LIST,
            )
    return settings


def _count_truths(value: object) -> int:
    """Return how many values are true or false, in lists too."""
    if isinstance(value, list | tuple):
        return sum(map(_count_truths, value))
    return isinstance(value, bool)


def _place(where: str, name: str, names: list[str]) -> int:
    if name not in names:
        raise unknown_name(where, name, names)
    return names.index(name)


def seconds_of(stage: str, limits: TimeLimits) -> float:
    """Return the time limit of the stage's units [s]."""
    return 60.0 * limits.get(stage, DEFAULT_MINUTES)


def parse_time_limits(given: Sequence[str]) -> TimeLimits:
    """Parse limits given as minutes for every stage, or as `stage=minutes`; later ones win."""
    limits: dict[str, float] = {}
    names = [stage.name for stage in METHOD]
    for text in given:
        stage, equals, number = text.rpartition("=")
        try:
            minutes = float(number)
        except ValueError:
            minutes = math.nan
        if not 0.0 < minutes < math.inf or (equals and stage not in names):
            raise UsageError(
                f"--time-limit {text}",
                expected=f"minutes, or stage=minutes with one of {', '.join(names)}",
                found=repr(text),
                todo="Write it as in: --time-limit detection=120.",
            )
        limits |= dict.fromkeys([stage] if equals else names, minutes)
    return limits
