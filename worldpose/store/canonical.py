"""Canonical byte string of a value, so that equal values have equal digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Final

from worldpose.errors import InputError

_CONTAINERS: Final = (dict, list, tuple)


def canonical_json(value: object) -> bytes:
    """Return the JSON of `value`: sorted keys, no spaces, UTF-8, finite numbers only.

    Raises:
        InputError: the value contains something without an exact JSON form: NaN, infinity, a key
            that is not text, a lone surrogate, an array.
    """
    try:
        text = json.dumps(
            value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )
        _refuse_other_keys(value)
        return text.encode("utf-8")
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(
            "a value to be stored or hashed",
            expected="plain JSON: text, finite numbers, true, false, null, lists, text-keyed maps",
            found=str(error),
            todo="Replace missing numbers by null and arrays by lists.",
        ) from error


def _refuse_other_keys(value: object) -> None:
    # json.dumps silently turns a key 1 into "1", and two values would share a digest. It has
    # already refused a value that contains itself, so this recursion ends.
    containers = [value] if isinstance(value, _CONTAINERS) else []
    for container in containers:
        inner: Iterable[object] = container
        if isinstance(container, dict):
            for key in container:
                if not isinstance(key, str):
                    raise TypeError(f"the key {key!r} of type {type(key).__name__}")
            inner = container.values()
        containers += [each for each in inner if isinstance(each, _CONTAINERS)]


def digest(data: bytes) -> str:
    """Return the SHA-256 of `data` in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()
