"""Sealed documents and groups of arrays: what is written is read, and damage is found."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from store_samples import (
    ATTRIBUTES,
    LAYOUT,
    all_sample_arrays,
    sample_coordinates,
    sample_recipe,
    sample_record,
)

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.run import RunRecord
from worldpose.errors import CorruptionError, InputError, InternalError
from worldpose.store.documents import canonical_json, seal, unseal
from worldpose.store.groups import write_group
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
def test_value_comes_back_and_is_written_the_same_again(value):
    data = canonical_json(value)
    assert (json.loads(data), canonical_json(json.loads(data))) == (value, data)


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
def test_values_that_are_nearly_the_same_have_bytes_of_their_own(one, other):
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
def test_value_that_json_cannot_say_exactly_is_refused(value):
    with pytest.raises(InputError, match="plain JSON"):
        canonical_json(value)


DOCUMENT = seal(sample_record("0001", sample_recipe()))


@given(st.integers(0, len(DOCUMENT) - 1), st.integers(0, 7))
def test_every_flipped_bit_is_corruption(index, bit):
    flipped = bytearray(DOCUMENT)
    flipped[index] ^= 1 << bit
    with pytest.raises(CorruptionError, match="the place is damaged"):
        unseal(RunRecord, bytes(flipped), "the place")


@pytest.mark.parametrize(
    "data", [b"", b"\xff", b"[]", b"1", b"null", b"{}", b"[" * 100_000, DOCUMENT + b" "]
)
def test_other_json_is_corruption(data):
    with pytest.raises(CorruptionError):
        unseal(RunRecord, data, "the place")


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
def test_every_change_has_its_own_line_and_its_own_key(change, line):
    changed = sample_recipe(**change)
    assert [str(each) for each in recipe_differences(sample_recipe(), changed)] == [line]
    assert recipe_key(changed) != recipe_key(sample_recipe())


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write(folder, **changes):
    arrays = {**all_sample_arrays(), **changes}
    write_group(folder, LAYOUT, arrays, sample_coordinates(), ATTRIBUTES)
    return contents(folder)


def test_equal_arrays_give_equal_files(tmp_path):
    one = write(tmp_path / "one")
    arrays = dict(reversed(all_sample_arrays().items()))
    # Another memory order, other sequence types and orders of names: the same content.
    arrays["joints"] = np.asfortranarray(arrays["joints"])
    attributes = dict(reversed(ATTRIBUTES.items()))
    attributes["camera"] = tuple(attributes["camera"])
    write_group(tmp_path / "two", LAYOUT, arrays, sample_coordinates(), attributes)
    assert contents(tmp_path / "two") == one


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": np.zeros((40, 3, 3), ">f8")}, "expected dtype float64, found dtype >f8"),
        ({"joints": np.zeros((40, 3))}, r"expected dimensions \(frame, person, coordinate\)"),
        ({"joints": np.zeros((39, 3, 3))}, "dimension frame: expected size 40, as in array frame"),
        ({"inliers": np.zeros((40, 4), bool)}, "dimension person: expected size 3"),
        ({"joints": np.full((40, 3, 3), np.inf)}, r"joints\[0, 0, 0\]: expected finite numbers or"),
        ({"height": np.array(np.nan, np.float32)}, r"height\[\]: expected finite numbers only"),
        ({"detection_index": np.full((40, 2), -2, np.int16)}, "or -1 for missing, found -2; 80"),
        ({"unplanned": np.zeros(3)}, "unknown: unplanned"),
    ],
)
def test_array_that_breaks_the_layout_is_refused(tmp_path, changes, message):
    with pytest.raises(InternalError, match=message):
        write(tmp_path, **changes)
    assert list(tmp_path.iterdir()) == [], "checked before anything is written"


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"camera": ["left", "right"]}, "absent: detector"),
        ({**ATTRIBUTES, "more": 1}, "unknown: more"),
        ({**ATTRIBUTES, "camera": ["left"]}, "expected a list of 2 labels.*found 1 labels"),
        ({**ATTRIBUTES, "camera": "left"}, "found 'left'"),
        ({**ATTRIBUTES, "detector": float("nan")}, "plain JSON"),
    ],
)
def test_attribute_that_breaks_the_layout_is_refused(tmp_path, attributes, message):
    with pytest.raises(InternalError, match=message):
        write_group(tmp_path, LAYOUT, all_sample_arrays(), sample_coordinates(), attributes)


@settings(max_examples=15)
@given(
    st.sampled_from(["float64", "float32", "int64", "int32", "int16", "uint8", "bool"]), st.data()
)
def test_any_array_of_any_shape_comes_back(dtype, data):
    import tempfile

    shape = data.draw(hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=40))
    finite = {"allow_infinity": False, "allow_nan": True} if dtype.startswith("f") else {}
    values = data.draw(hnp.arrays(dtype, shape, elements=finite, fill=None))
    dims = ("frame", "a", "b")[: len(shape)]
    missing = "nan" if dtype.startswith("f") else "none"
    array = ArrayLayout(
        name="x", dims=dims, dtype=dtype, unit="1", missing=missing, about="x", chunk_dim="frame"
    )
    layout = GroupLayout(stage="any", about="any", arrays=(array,))
    with tempfile.TemporaryDirectory() as folder:
        write_group(Path(folder), layout, {"x": values}, {}, {})
        stored = zarr.open_group(folder, mode="r")["x"]
        np.testing.assert_array_equal(stored[...], values)


def test_xarray_opens_the_folder_itself_without_a_warning(tmp_path):
    write(tmp_path / "group")
    (tmp_path / "group" / "manifest.json").write_text("{}")  # as in the store
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened = xr.open_zarr(tmp_path / "group")
        np.testing.assert_array_equal(opened["joints"].values, all_sample_arrays()["joints"])
