"""One byte string for one value, so that equal things have equal digests."""

from __future__ import annotations

import hashlib
import json

from worldpose.errors import InputError


def canonical_json(value: object) -> bytes:
    """The JSON of `value`: sorted keys, no spaces, UTF-8, finite numbers only.

    Raises:
        InputError: the value holds something that JSON cannot say exactly: NaN, infinity, a key
            that is not text, a half surrogate, an array.
    """
    try:
        _refuse_other_keys(value)
        text = json.dumps(
            value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )
        return text.encode("utf-8")
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(
            "a value to be stored or hashed",
            expected="plain JSON: text, finite numbers, true, false, null, lists, text-keyed maps",
            found=str(error),
            todo="Replace missing numbers by null and arrays by lists.",
        ) from error


def _refuse_other_keys(value: object) -> None:
    # json.dumps turns a key 1 into "1" without a word, and two values would share a digest.
    if isinstance(value, dict):
        for key, inner in value.items():
            if not isinstance(key, str):
                raise TypeError(f"the key {key!r} of type {type(key).__name__}")
            _refuse_other_keys(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            _refuse_other_keys(inner)


def digest(data: bytes) -> str:
    """SHA-256 of `data` in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()
