"""Readers of untrusted YAML, JSON and TOML files; `InputError` for hostile or broken files."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, Final

import yaml

from worldpose.errors import InputError

SETTINGS_BYTES: Final = 1 << 21
"""Maximum size of match.yaml, calibration.toml or pitch.json [byte].

A full match has 0.1 MB; 5,000 calibrated cameras, as in the load test, take 2.0 MB.
"""

NESTING: Final = 32
"""Maximum levels of lists and mappings in a YAML file; match.yaml has four."""

EVENTS: Final = 100_000
"""Maximum keys, values and brackets in a YAML file, two seconds' work; 1000 clips have 10 000."""


TOML_LINE: Final = 4096
"""Maximum line length of a TOML file; the time for a key of n dotted parts grows as n squared."""


def read_yaml(path: Path) -> Any:  # noqa: ANN401
    """Return the only document of a YAML file, as plain values, without aliases or repeated keys.

    Dates stay text, so that `match_id: 2024-05-01` is a name.

    Raises:
        InputError: no such file, too large, not YAML, nested too deep, an alias or a repeated key.
    """
    text = _text(path, SETTINGS_BYTES)
    return _parsed(path, "YAML", _load_yaml, text)


def read_json(path: Path, limit: int = SETTINGS_BYTES) -> Any:  # noqa: ANN401
    """Return the content of a JSON file of at most `limit` bytes, including NaN and Infinity.

    Raises:
        InputError: no such file, too large or not JSON.
    """
    return _parsed(path, "JSON", json.loads, _text(path, limit))


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        InputError: no such file, too large, a line too long, or not TOML.
    """
    text = _text(path, SETTINGS_BYTES)
    longest = max(map(len, text.splitlines()), default=0)
    if longest > TOML_LINE:
        raise InputError(
            str(path),
            expected=f"lines of at most {TOML_LINE} characters",
            found=f"one of {longest}",
            todo="Break the line.",
        )
    tables: dict[str, Any] = _parsed(path, "TOML", tomllib.loads, text)
    return tables


def require_file(path: Path) -> int:
    """Return the size of a regular file [byte].

    Raises:
        InputError: there is no such file, it is not a regular file, or it is unreachable.
    """
    try:
        if not path.is_file():
            raise InputError(
                str(path),
                expected="a file",
                found="something else" if path.exists() else "nothing",
                todo="Put the file there, or correct the name.",
            )
        return path.stat().st_size
    except (OSError, ValueError) as error:
        raise InputError(
            str(path),
            expected="a readable file",
            found=str(error),
            todo="Check its name and rights.",
        ) from error


def _text(path: Path, limit: int) -> str:
    size = require_file(path)
    if size > limit:
        raise InputError(
            str(path),
            expected=f"at most {limit} bytes",
            found=f"{size} bytes",
            todo="Check that it is the file that is meant.",
        )
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(
            str(path), expected="readable UTF-8 text", found=str(error), todo="Save it as UTF-8."
        ) from error


def _parsed(path: Path, form: str, parse: Callable[[str], Any], text: str) -> Any:  # noqa: ANN401
    try:
        return parse(text)
    except RecursionError as error:
        raise InputError(
            str(path), expected=form, found="nesting without end", todo="Write the file anew."
        ) from error
    # ValueError: json and tomllib, and numbers or dates that Python's constructors reject.
    # The others: PyYAML, where a tag such as !!int or !!bool precedes text of another type.
    except (yaml.YAMLError, ValueError, OverflowError, LookupError, AttributeError) as error:
        found = " ".join(str(error).replace('"<unicode string>", ', "").split())
        raise InputError(
            str(path), expected=form, found=found, todo="Correct the place that is named."
        ) from error


class _Loader(yaml.SafeLoader):
    """Safe loader that rejects aliases and repeated keys, and reads dates as text."""

    yaml_implicit_resolvers = {
        first: [(tag, regexp) for tag, regexp in rules if not tag.endswith(":timestamp")]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} is given twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _load_yaml(text: str) -> Any:  # noqa: ANN401
    # Events arrive one by one, so that the check rejects a bomb before construction.
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=yaml.SafeLoader)):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias (*), which is not allowed {event.start_mark}")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if count > EVENTS:
            raise yaml.YAMLError(f"more than {EVENTS} entries")
        if depth > NESTING:
            raise yaml.YAMLError(f"more than {NESTING} levels {event.start_mark}")
    return yaml.load(text, Loader=_Loader)
