from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from store_samples import ATTRIBUTES, LAYOUT, all_sample_arrays, sample_coordinates

from data_contracts.arrays import ArrayLayout, GroupLayout
from worldpose.errors import InternalError
from worldpose.store.groups import write_group


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write(folder: Path, **changes: Any) -> dict[str, bytes]:
    arrays = {**all_sample_arrays(), **changes}
    write_group(folder, LAYOUT, arrays, sample_coordinates(), ATTRIBUTES)
    return contents(folder)


def test_equal_arrays_give_equal_files(tmp_path: Path) -> None:
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
        ({"joints": np.zeros((40, 3, 3), np.float32)}, "expected dtype float64, found dtype fl"),
        ({"joints": np.zeros((40, 3, 3), ">f8")}, "found dtype >f8"),
        ({"joints": np.zeros((40, 3))}, r"expected dimensions \(frame, person, coordinate\)"),
        ({"joints": np.zeros((39, 3, 3))}, "dimension frame: expected size 40, as in array frame"),
        ({"inliers": np.zeros((40, 4), bool)}, "dimension person: expected size 3"),
        ({"joints": np.full((40, 3, 3), np.inf)}, r"joints\[0, 0, 0\]: expected finite numbers or"),
        ({"height": np.array(np.nan, np.float32)}, r"height\[\]: expected finite numbers only"),
        ({"detection_index": np.full((40, 2), -2, np.int16)}, "or -1 for missing, found -2; 80"),
        ({"unplanned": np.zeros(3)}, "unknown: unplanned"),
    ],
)
def test_array_that_breaks_the_layout_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
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
def test_attribute_that_breaks_the_layout_is_refused(
    tmp_path: Path, attributes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InternalError, match=message):
        write_group(tmp_path, LAYOUT, all_sample_arrays(), sample_coordinates(), attributes)


@settings(max_examples=15)
@given(
    st.sampled_from(["float64", "float32", "int64", "int32", "int16", "uint8", "bool"]), st.data()
)
def test_any_array_of_any_shape_comes_back(dtype: Any, data: st.DataObject) -> None:
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
        np.testing.assert_array_equal(stored[...], values)  # type: ignore[index]


def test_xarray_opens_the_folder_itself_without_a_warning(tmp_path: Path) -> None:
    write(tmp_path / "group")
    (tmp_path / "group" / "manifest.json").write_text("{}")  # as in the store
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened = xr.open_zarr(tmp_path / "group")
        np.testing.assert_array_equal(opened["joints"].values, all_sample_arrays()["joints"])
