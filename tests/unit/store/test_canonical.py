from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldpose.errors import InputError
from worldpose.store.canonical import canonical_json, digest

TEXT = st.text(st.characters(exclude_categories=["Cs"]))
NUMBERS = st.integers() | st.floats(allow_nan=False, allow_infinity=False)
FEW = st.recursive(
    st.sampled_from([None, False, True, 0, 1, 1.5, "", "0", "null"]),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from("ab"), inner),
    max_leaves=3,
)
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


@settings(max_examples=50)
@given(st.dictionaries(TEXT, VALUES, max_size=5))
def test_order_of_keys_does_not_matter(value: dict[str, object]) -> None:
    assert canonical_json(dict(reversed(value.items()))) == canonical_json(value)


@given(FEW | VALUES, FEW | VALUES)
def test_equal_bytes_mean_equal_values(one: object, other: object) -> None:
    if canonical_json(one) == canonical_json(other):
        assert one == other


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, True),
        (0, False),
        (1, 1.0),
        (0.1, 0.1 + 2.0**-56),
        (2**53, 2**53 + 1),
        (1, "1"),
        (None, "null"),
        ([], {}),
        ([1, 2], [2, 1]),
        ([[1], 2], [1, [2]]),
        ({"a": None}, {}),
        ("\u00e9", "e\u0301"),
        ("a", "a "),
    ],
)
def test_values_that_are_nearly_the_same_have_bytes_of_their_own(
    one: object, other: object
) -> None:
    assert canonical_json(one) != canonical_json(other)


def test_form_is_sorted_and_without_spaces() -> None:
    value = {"b": [1, 2.5, None, True], "a": {"é": "x"}}
    assert canonical_json(value) == '{"a":{"é":"x"},"b":[1,2.5,null,true]}'.encode()


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
    ],
)
def test_value_that_json_cannot_say_exactly_is_refused(value: object) -> None:
    with pytest.raises(InputError, match="plain JSON"):
        canonical_json(value)


def test_value_nested_without_end_is_refused() -> None:
    endless: list[object] = []
    endless.append(endless)
    with pytest.raises(InputError, match="plain JSON"):
        canonical_json(endless)


def test_digest_is_sha256() -> None:
    # FIPS 180-2, appendix B.1.
    assert digest(b"abc").startswith("ba7816bf8f01cfea414140de5dae2223")
