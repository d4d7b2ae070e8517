"""Settings page: the layers of the project, its venues and one match."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, Final

from fastapi import APIRouter, HTTPException
from pydantic import JsonValue

from data_contracts.records import Name, Record
from flows.layers import (
    MATCHES,
    PROJECT,
    SETTINGS_LOCK,
    VENUES,
    Layer,
    list_venues,
    match_layer,
    project_layers,
    read_layer,
    read_layers,
    say_unnamed_venues,
)
from flows.settings import LIST, known_settings, resolve, save_layer
from flows.web.app_context import PageContext
from worldpose.errors import InputError
from worldpose.store.paths import is_name
from worldpose.store.runs import alone

ON_PAGE: Final = "The page lists the names as you type, and what each of them takes."


class SavedLayer(Record):
    """All values of a layer as a person changed them, and the revision that the person saw."""

    layer: str
    values: dict[str, JsonValue]
    revision: str


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the settings page."""
    router = APIRouter(prefix="/api/settings")
    store = context.store

    def layers_of(match: str | None) -> tuple[Layer, ...]:
        if match is None:
            return project_layers(store)
        registered = store.registration(match) if match in store.matches() else None
        if registered is None:
            raise HTTPException(404, "no such match")
        return read_layers(store, registered.spec)

    @router.get("")
    def settings(match: Name | None = None) -> dict[str, Any]:
        layers, problem = layers_of(match), ""
        in_force: dict[str, dict[str, JsonValue]] = {}
        try:
            in_force = resolve(layers).differences()
        except InputError as error:  # the page is where it is corrected
            problem = str(_on_page(error, layers))
        names = [PROJECT, *(f"{VENUES}/{each}" for each in list_venues(store))]
        names += [] if match is None else [match_layer(match)]
        return {
            "layers": [
                {"layer": name, "values": layer.values, "revision": layer.revision}
                for name in names
                for layer in [read_layer(store, name)]
            ],
            "in_force": [{"name": each, **in_force[each]} for each in in_force],
            "problem": problem or say_unnamed_venues(store),
            "known": known_settings(),
        }

    @router.post("")
    def save(given: SavedLayer, match: Name | None = None) -> dict[str, Any]:
        kind, _, name = given.layer.partition("/")
        is_match = kind == MATCHES and name in store.matches()
        is_venue = kind == VENUES and is_name(name)
        if not (given.layer == PROJECT or is_match or is_venue):
            raise HTTPException(404, "no such layer of settings")
        # Of two saves of one revision, the second is refused.
        with alone(store.blobs, SETTINGS_LOCK, wait=True):
            save_revision(given, name if is_match else None)
        return settings(match)

    def save_revision(given: SavedLayer, match: str | None) -> None:
        before = read_layer(store, given.layer)
        if before.revision != given.revision:
            raise HTTPException(409, "another person changed these settings: load the page again")
        changed = {n: it for n, it in given.values.items() if it != before.values.get(n)}
        layers = layers_of(match)
        try:
            for key in filter(lambda key: _names_file(key, changed[key]), changed):
                raise InputError(
                    f"{before.file}: {key}",
                    expected="a value that names no file: pages cannot choose files of the server",
                    found=repr(changed[key]),
                    todo=f"On the server: worldpose settings --set {key}=...",
                )
            save_layer(store, layers, given.layer, given.values)
        except InputError as error:
            raise _on_page(error, (before, *layers)) from error

    return router


def _on_page(error: InputError, layers: Iterable[Layer]) -> InputError:
    """Return an error that names layers as the page does, and says what its reader can do."""
    where, todo = error.where, error.todo.replace(LIST, ON_PAGE)
    for layer in layers:
        where = where.replace(layer.file, f"settings of the {layer.origin}")
    return InputError(where, error.expected, error.found, todo)


def _names_file(key: str, value: JsonValue) -> bool:
    """Return whether a value can name a file or folder: code in it could run."""
    if isinstance(value, list | dict):
        inner = value if isinstance(value, list) else [*value, *value.values()]
        return any(_names_file(key, each) for each in inner)
    is_path = key.endswith("folder") or not re.fullmatch(r"(model:)?[^/\\:~]*", str(value))
    return isinstance(value, str) and is_path
