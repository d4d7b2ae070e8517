"""Command settings: the layers of settings of a project, its venues and its matches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from data_contracts.match import MatchSpec
from flows.cli.console import answer, errors, line, print_json
from flows.cli.options import DEFAULT_PROJECT
from flows.layers import (
    PROJECT,
    SETTINGS_LOCK,
    VENUES,
    Layer,
    check_general,
    list_venues,
    match_layer,
    project_layers,
    read_layer,
    read_layers,
    say_unnamed_venues,
)
from flows.registering import find_match, find_registration
from flows.settings import as_text, known_settings, parse_value, require_known, resolve, save_layer
from worldpose.errors import InputError, UsageError, unknown_name
from worldpose.ingest.match_folder import read_spec
from worldpose.store.runs import alone
from worldpose.store.store import Store

NAME_WIDTH, ABOUT_WIDTH = 42, 56
"""Widths of a setting with its built-in value, and of what it says [characters]."""


def settings(
    match: Annotated[str | None, typer.Argument(metavar="[MATCH]")] = None,
    venue: str | None = None,
    assignments: Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE")] = None,
    removed: Annotated[list[str] | None, typer.Option("--unset", metavar="NAME")] = None,
    add: bool = False,
    list_all: Annotated[bool, typer.Option("--list")] = False,
    described: Annotated[str | None, typer.Option("--describe", metavar="NAME")] = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Show or change the settings of a project, a venue or a match, and where each is from.

    A run takes each value from the last of these layers that states it: built in, project, venue,
    match. What worldpose run states with --set, --iterations and --body-folder becomes the layer of
    its match. Each value that differs from the built-in one is shown.

    Example: worldpose settings --set body_fitting.body_model=smpl-neutral --set iterations=2

    Options:
        match: A match folder or id; without it, the project's settings.
        venue: The venue that is shown or changed; a match names its own with --set venue=NAME.
        assignments: Change a setting of the match, the venue or the project; repeatable.
        removed: Remove a setting there, so that an earlier layer decides; repeatable.
        add: With --venue, add a venue that states nothing yet.
        list_all: List all settings with their built-in values.
        described: Describe one setting, as in --describe triangulation.min_views.
    """
    if (list_all or described is not None) and (assignments or removed or add):
        expected, found = "--list and --describe alone", "a change beside them"
        raise UsageError("worldpose settings", expected, found, "Change settings without them.")
    if list_all:
        print_known()
        return
    if described is not None:
        require_known(described, f"--describe {described}")
        it = known_settings()[described]
        about = f"{described} = {as_text(it['default'])}, built in", str(it["about"])
        answer({described: it}, *about)
        return
    store = Store.open(project)
    name, layers = _read(store, match, venue, is_new=add)
    if assignments or removed or add:
        change_layer(store, name, layers, assignments or (), removed or ())
        name, layers = _read(store, match, venue)  # a match can have another venue now
    told: dict[str, Any] = {"layer": name, "settings": resolve(layers).differences()}
    if match is None and venue is None:
        venues = {each: read_layer(store, f"{VENUES}/{each}") for each in list_venues(store)}
        told["venues"] = {each: dict(layer.values) for each, layer in venues.items()}
    answer(told, *_lines(told))
    if problem := say_unnamed_venues(store):
        line(problem, to=errors)


def _read(
    store: Store, match: str | None, venue: str | None, *, is_new: bool = False
) -> tuple[str, tuple[Layer, ...]]:
    """Return the name of the chosen layer, and all up to it."""
    if (match is not None and venue is not None) or (is_new and venue is None):
        raise UsageError(
            "worldpose settings",
            expected="a match or --venue; --add with --venue",
            found="another combination",
            todo="Give a match its venue: worldpose settings MATCH --set venue=NAME.",
        )
    if match is not None:
        spec = _spec_of(store, match)
        return match_layer(spec.match_id), read_layers(store, spec)
    if venue is None:
        return PROJECT, project_layers(store)
    name = f"{VENUES}/{venue}"
    return name, (*project_layers(store), read_layer(store, name))


def _spec_of(store: Store, match: str) -> MatchSpec:
    """Return match.yaml of a match, which need not fit its settings; a new folder is registered."""
    folder = Path(match)
    if not (folder / "match.yaml").is_file():
        return find_registration(store, match).spec
    spec = read_spec(folder)
    known = store.registration(spec.match_id)
    if known is None or known.folder != str(folder.resolve()):
        find_match(store, match, unfinished=True)
    return spec


def print_known() -> None:
    """Print all settings, one short line each, by stages."""
    known = known_settings()
    print_json(known)
    shown = None
    for name, it in known.items():
        stage, _, short = name.rpartition(".")
        if stage != shown:
            line(f"\n{stage}" if stage else "runs")
            shown = stage
        text = _cut(f"  {short} = {as_text(it['default'])}", NAME_WIDTH)
        about = str(it["about"]).partition(". ")[0].rstrip(".")
        line(f"{text:{NAME_WIDTH}}  {_cut(about, ABOUT_WIDTH)}")
    line("\nworldpose settings --describe NAME tells all about one, as in triangulation.min_views")


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"


def change_layer(
    store: Store,
    name: str,
    layers: Sequence[Layer],
    assignments: Sequence[str],
    removed: Sequence[str],
) -> None:
    """Write a layer with changes."""
    with alone(store.blobs, SETTINGS_LOCK, wait=True):
        values = dict(read_layer(store, name).values)
        for text in assignments:
            key, equals, value = text.partition("=")
            if not equals:
                raise UsageError(
                    f"--set {text}",
                    expected="NAME=VALUE",
                    found=repr(text),
                    todo="Write it as in: --set detection.stride=2.",
                )
            require_known(key, f"--set {text}")
            values[key] = parse_value(value, key)
            try:
                check_general(name, "--set", {key: values[key]})
            except InputError as error:
                todo = f"{error.todo} {known_settings()[key]['about']}"
                raise UsageError(f"--set {text}", error.expected, error.found, todo) from error
        for key in removed:
            if key not in values:
                raise unknown_name(f"--unset {key}", key, values)
            del values[key]
        save_layer(store, layers, name, values)


def _lines(told: dict[str, Any]) -> Iterator[str]:
    for name, each in told["settings"].items():
        value, default = as_text(each["value"]), as_text(each["default"])
        yield f"{name} = {value}  ({each['from']}; built in: {default})"
    if not told["settings"]:
        yield "All settings have their built-in values."
    for venue, values in told.get("venues", {}).items():
        stated = ", ".join(f"{name} = {as_text(value)}" for name, value in values.items())
        yield f"venue {venue}: {stated or 'nothing stated'}"
