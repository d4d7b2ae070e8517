from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from store_samples import sample_recipe, sample_record

from data_contracts.run import RunRecord
from worldpose.errors import CorruptionError, InputError
from worldpose.store.documents import canonical_json, seal, unseal
from worldpose.store.recipes import recipe_differences, recipe_key

TEXT = st.text(st.characters(exclude_categories=["Cs"]))
NUMBERS = st.integers() | st.floats(allow_nan=False, allow_infinity=False)
"""So few that two of them are often the same."""
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXT,
    lambda inner: st.lists(inner) | st.dictionaries(TEXT, inner),
    max_leaves=6,
)


@given(VALUES)
def test_value_comes_back_and_is_written_the_same_again(value: object) -> None:
    data = canonical_json(value)
    assert json.loads(data) == value
    assert canonical_json(json.loads(data)) == data


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, True),
        (1, 1.0),
        (0.1, 0.1 + 2.0**-56),
        (2**53, 2**53 + 1),
        (1, "1"),
        ([], {}),
        ([[1], 2], [1, [2]]),
        ({"a": None}, {}),
        ("\u00e9", "e\u0301"),
    ],
)
def test_values_that_are_nearly_the_same_have_bytes_of_their_own(
    one: object, other: object
) -> None:
    assert canonical_json(one) != canonical_json(other)


ENDLESS: list[object] = []
ENDLESS.append(ENDLESS)


@pytest.mark.parametrize(
    "value",
    [
        math.nan,
        {"a": [1, -math.inf]},
        {1: "one"},
        {"a": {None: 1}},
        {"a": np.float32(1)},
        np.zeros(2),
        "\ud800",
        {"a": object()},
        ENDLESS,
    ],
)
def test_value_that_json_cannot_say_exactly_is_refused(value: object) -> None:
    with pytest.raises(InputError, match="plain JSON"):
        canonical_json(value)


DOCUMENT = seal(sample_record("0001", sample_recipe()))


@given(st.integers(0, len(DOCUMENT) - 1), st.integers(0, 7))
def test_every_flipped_bit_is_corruption(index: int, bit: int) -> None:
    flipped = bytearray(DOCUMENT)
    flipped[index] ^= 1 << bit
    with pytest.raises(CorruptionError, match="the place is damaged"):
        unseal(RunRecord, bytes(flipped), "the place")


@pytest.mark.parametrize(
    "data", [b"", b"\xff", b"[]", b"1", b"null", b"{}", b"[" * 100_000, DOCUMENT + b" "]
)
def test_other_json_is_corruption(data: bytes) -> None:
    with pytest.raises(CorruptionError):
        unseal(RunRecord, data, "the place")


def describe(old, new):
    return [str(each) for each in recipe_differences(old, new)]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"unit": "late"}, "unit: tracking/clip -> tracking/late"),
        ({"match_id": "semi"}, "match: final -> semi"),
        ({"sources": {"pitch": "f" * 64}}, "source pitch: aaaaaaaaaaaa... -> ffffffffffff..."),
        ({"sources": {}}, "source pitch: aaaaaaaaaaaa... -> absent"),
        ({"inputs": {"ingest/left": "e" * 32}}, "input ingest/left: absent -> eeeeeeeeeeee..."),
        ({"settings": {"gate": {"max_distance": 0.7}}}, "setting gate.max_distance: 0.5 -> 0.7"),
        ({"settings": {"gate": {"max_distance": None}}}, "setting gate.max_distance: 0.5 -> null"),
        (
            {"code": {"worldpose.tracking": "c" * 64}},
            "module worldpose.tracking: bbbbbbbbbbbb... -> cccccccccccc...",
        ),
        ({"libraries": {"numpy": "2.5.0"}}, "library numpy: 2.4.0 -> 2.5.0"),
    ],
)
def test_every_change_has_its_own_line_and_its_own_key(change: dict[str, Any], line: str) -> None:
    changed = sample_recipe(**change)
    assert describe(sample_recipe(), changed) == [line]
    assert recipe_key(changed) != recipe_key(sample_recipe())
