"""Validation of arrays against their layout."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ArrayLayout, GroupLayout
from worldpose.errors import InputError, InternalError
from worldpose.store.canonical import canonical_json

Arrays = Mapping[str, NDArray[Any]]

PART_CHUNKS = 16
"""Chunks of an array in memory at once: enough for every core to compress one."""


def checked_arrays(
    layout: GroupLayout, arrays: Arrays, coordinates: Arrays
) -> dict[str, NDArray[Any]]:
    """Return all arrays by name in the layout's order, unchanged.

    Raises:
        InternalError: an array is unknown, absent, of another dtype or dimension, disagrees with
            another in a dimension's size, or holds NaN or infinity against its layout.
    """
    _check_names(layout, "array", arrays, [array.name for array in layout.arrays])
    _check_names(layout, "coordinate", coordinates, [array.name for array in layout.coordinates])
    given = {**coordinates, **arrays}
    sizes = {dim: (len(names), "the layout's labels") for dim, names in layout.labels.items()}
    checked = {}
    for array in (*layout.coordinates, *layout.arrays):
        if array.name not in given:
            continue
        where = f"{layout.stage}: array {array.name}"
        values = np.asarray(given[array.name])
        _check_form(where, array, values)
        for dim, size in zip(array.dims, values.shape, strict=True):
            expected, source = sizes.setdefault(dim, (size, f"array {array.name}"))
            if size != expected:
                raise InternalError(
                    f"{where}, dimension {dim}",
                    f"expected size {expected}, as in {source}, found size {size}, shape "
                    f"{values.shape}",
                )
        _check_values(where, array, values)
        checked[array.name] = values
    return checked


def array_parts(array: ArrayLayout, shape: tuple[int, ...]) -> list[tuple[slice, ...]]:
    """Return the slices of consecutive parts of an array of `shape`: a few whole chunks each.

    An array can be longer than memory, so it is processed one part at a time.
    """
    if 0 in shape:
        return []
    whole = tuple(slice(0, size) for size in shape)
    if array.chunk_dim is None:
        return [whole]
    axis = array.dims.index(array.chunk_dim)
    size, length = shape[axis], PART_CHUNKS * array.chunks(shape)[axis]
    return [
        (*whole[:axis], slice(first, min(first + length, size)), *whole[axis + 1 :])
        for first in range(0, size, length)
    ]


def with_one_nan(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values with one bit pattern for every NaN.

    The sign and payload of NaNs depend on the processor's code path.
    """
    if values.dtype.kind != "f":
        return values
    return np.where(np.isnan(values), values.dtype.type(np.nan), values)


def checked_attributes(
    layout: GroupLayout, arrays: Arrays, attributes: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the group's attributes as plain JSON, in the layout's order.

    An attribute with the name of a dimension labels it, so it must be a list of the dimension's
    size.

    Raises:
        InternalError: an attribute is unknown, absent, not plain JSON, or a wrong label of a
            dimension.
    """
    _check_names(layout, "attribute", attributes, list(layout.attributes))
    try:
        plain: dict[str, Any] = json.loads(canonical_json(dict(attributes)))
    except InputError as error:
        raise InternalError(
            f"{layout.stage}: attributes", f"expected {error.expected}, found {error.found}"
        ) from error
    sizes = {
        dim: size
        for array in (*layout.coordinates, *layout.arrays)
        if array.name in arrays
        for dim, size in zip(array.dims, arrays[array.name].shape, strict=True)
    }
    for name in plain.keys() & sizes.keys():
        value = plain[name]
        if not isinstance(value, list) or len(value) != sizes[name]:
            found = f"{len(value)} of them" if isinstance(value, list) else repr(value)
            raise InternalError(
                f"{layout.stage}: attribute {name}",
                f"expected a list of {sizes[name]} labels, one for each {name}, found {found}",
            )
    return {name: plain[name] for name in layout.attributes if name in plain}


def _check_names(
    layout: GroupLayout, kind: str, given: Mapping[str, Any], known: list[str]
) -> None:
    unknown = sorted(given.keys() - set(known))
    absent = sorted(set(known) - given.keys() - set(layout.optional))
    if unknown or absent:
        raise InternalError(
            f"{layout.stage}: {kind}s",
            f"expected {', '.join(known) or 'none'}, found unknown: "
            f"{', '.join(unknown) or 'none'}; absent: {', '.join(absent) or 'none'}",
        )


def _check_form(where: str, array: ArrayLayout, values: NDArray[Any]) -> None:
    if values.dtype != np.dtype(array.dtype):
        raise InternalError(where, f"expected dtype {array.dtype}, found dtype {values.dtype}")
    if values.ndim != len(array.dims):
        raise InternalError(
            where, f"expected dimensions ({', '.join(array.dims)}), found shape {values.shape}"
        )


def _check_values(where: str, array: ArrayLayout, values: NDArray[Any]) -> None:
    number, first, value = 0, (), None
    for part in array_parts(array, values.shape):
        wrong = _wrong_values(array, values[part])
        if not wrong.any():
            continue
        if not number:
            inside = np.argwhere(wrong)[0]
            first = tuple(int(i) + at.start for i, at in zip(inside, part, strict=True))
            value = values[first]
        number += int(wrong.sum())
    if number:
        allowed = {"nan": "finite numbers or NaN", "-1": "indices from 0, or -1 for missing"}
        expected = allowed.get(array.missing, "finite numbers only")
        raise InternalError(
            f"{where}{list(first)}", f"expected {expected}, found {value}, and {number} such in all"
        )


def _wrong_values(array: ArrayLayout, values: NDArray[Any]) -> NDArray[np.bool_]:
    wrong: NDArray[np.bool_] = np.zeros((), dtype=np.bool_)
    if values.dtype.kind == "f":
        wrong = np.isinf(values) if array.missing == "nan" else ~np.isfinite(values)
    elif array.missing == "-1":
        wrong = values < -1
    return wrong
