"""Recipe of a result: its key, the versions of libraries, differences of two recipes."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

from data_contracts.work import Recipe
from worldpose.store.documents import canonical_json, digest

STORE_FORMAT = "3"
"""Increased when the same arrays are written as other bytes."""


@functools.cache
def libraries() -> dict[str, str]:
    """Return versions that affect a result's bytes: Python, numeric libraries, store format."""
    versions = {
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "store": STORE_FORMAT,
    }
    numeric_libraries = (
        *("numpy", "scipy", "numba", "opencv-python-headless", "av", "zarr", "numcodecs"),
    )
    for name in numeric_libraries:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "absent"
    return versions


def recipe_key(recipe: Recipe) -> str:
    """Return the key of the result of `recipe`: the first 128 bits of the recipe's SHA-256."""
    key_length = 32
    return digest(canonical_json(dict(recipe)))[:key_length]


DifferenceKind = Literal[
    "contract", "match", "unit", "source", "input", "setting", "module", "library", "recipe"
]


@dataclass(frozen=True)
class RecipeDifference:
    """One difference between two recipes.

    Attributes:
        kind: part of the recipe.
        name: name within that part; empty if the part is a single value.
        before: value in the old recipe as short text, or `absent`; `after` is that in the new one.
    """

    kind: DifferenceKind
    name: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.kind} {self.name}".rstrip() + f": {self.before} -> {self.after}"


def recipe_differences(old: Recipe, new: Recipe) -> list[RecipeDifference]:
    """Return the differences between `old` and `new`; empty if equal."""
    found = [
        *_changes("contract", {"": old.contract}, {"": new.contract}),
        *_changes("match", {"": old.match_id}, {"": new.match_id}),
        *_changes("unit", {"": old.name}, {"": new.name}),
        *_changes("source", _flatten(old.sources), _flatten(new.sources)),
        *_changes("input", old.inputs, new.inputs),
        *_changes("setting", _flatten(old.settings), _flatten(new.settings)),
        *_changes("module", old.code, new.code),
        *_changes("library", old.libraries, new.libraries),
    ]
    # Digests with equal prefixes look equal when shortened; every difference must show.
    if not found and recipe_key(old) != recipe_key(new):
        found.append(RecipeDifference("recipe", "", recipe_key(old), recipe_key(new)))
    return found


def _changes(
    kind: DifferenceKind, old: Mapping[str, Any], new: Mapping[str, Any]
) -> Iterator[RecipeDifference]:
    for name in sorted(old.keys() | new.keys()):
        before, after = _format_value(old, name), _format_value(new, name)
        if before != after:
            yield RecipeDifference(kind, name, before, after)


def _format_value(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "absent"
    value = values[name]
    text = value if isinstance(value, str) else canonical_json(value).decode()
    is_digest = len(text) in (32, 64) and set(text) <= set("0123456789abcdef")
    return f"{text[:12]}..." if is_digest else text


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return every leaf by its path: `camera.focal_px[0]`."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            flat.update(_flatten(value, f"{prefix}{name}."))
        elif isinstance(value, list | tuple) and value:
            items = {f"{name}[{index}]": item for index, item in enumerate(value)}
            flat.update(_flatten(items, prefix))
        else:
            flat[prefix + name] = value
    return flat
