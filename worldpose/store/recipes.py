"""Key of a result, and the differences between two recipes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from data_contracts.work import Recipe
from worldpose.store.canonical import canonical_json, digest

KEY_LENGTH = 32


def key_of(recipe: Recipe) -> str:
    """Return the key of the result of `recipe`: the first 128 bits of the recipe's SHA-256."""
    return digest(canonical_json(dict(recipe)))[:KEY_LENGTH]


def explain_difference(old: Recipe, new: Recipe) -> list[str]:
    """Return one line per difference between `old` and `new`; empty if equal.

    Lines read `setting gate.max_distance: 0.5 -> 0.7` or `module worldpose.tracking.tracker:
    3f2a... -> 77b1...`; a missing side reads `absent`.
    """
    lines = [
        *_changes("contract", {"": old.contract}, {"": new.contract}),
        *_changes("match", {"": old.match_id}, {"": new.match_id}),
        *_changes("unit", {"": old.name}, {"": new.name}),
        *_changes("source", _flat(old.sources), _flat(new.sources)),
        *_changes("input", old.inputs, new.inputs),
        *_changes("setting", _flat(old.settings), _flat(new.settings)),
        *_changes("module", old.code, new.code),
        *_changes("library", old.libraries, new.libraries),
    ]
    # Digests with equal beginnings look equal when shortened; every difference must show.
    if not lines and key_of(old) != key_of(new):
        lines.append(f"recipe: {key_of(old)} -> {key_of(new)}")
    return lines


def _changes(kind: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for name in sorted(old.keys() | new.keys()):
        before, after = _shown(old, name), _shown(new, name)
        if before != after:
            yield f"{kind} {name}".rstrip() + f": {before} -> {after}"


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "absent"
    value = values[name]
    text = value if isinstance(value, str) else canonical_json(value).decode()
    is_digest = len(text) in (32, 64) and set(text) <= set("0123456789abcdef")
    return f"{text[:12]}..." if is_digest else text


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return every leaf by its path: `camera.focal_px[0]`."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            flat.update(_flat(value, f"{prefix}{name}."))
        elif isinstance(value, list | tuple) and value:
            items = {f"{name}[{index}]": item for index, item in enumerate(value)}
            flat.update(_flat(items, prefix))
        else:
            flat[prefix + name] = value
    return flat
