"""Do arrays keep what their layout promises."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ArrayLayout, GroupLayout
from worldpose.errors import InputError
from worldpose.store.canonical import canonical_json

Arrays = Mapping[str, NDArray[Any]]


def checked_arrays(
    layout: GroupLayout, arrays: Arrays, coordinates: Arrays
) -> dict[str, NDArray[Any]]:
    """All arrays by name in the layout's order, with one bit pattern for every NaN.

    Raises:
        InputError: an array is unknown, absent, of another dtype or dimension, disagrees with
            another in a dimension's size, or holds NaN or infinity where there must be none.
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
                raise InputError(
                    f"{where}, dimension {dim}",
                    expected=f"size {expected}, as in {source}",
                    found=f"size {size}, shape {values.shape}",
                    todo="Give every array of the group the same dimension sizes.",
                )
        checked[array.name] = _checked_values(where, array, values)
    return checked


def checked_attributes(
    layout: GroupLayout, arrays: Arrays, attributes: Mapping[str, Any]
) -> dict[str, Any]:
    """The group's attributes as plain JSON, in the layout's order.

    An attribute named as a dimension labels it, so it must be a list of the dimension's size.

    Raises:
        InputError: an attribute is unknown, absent, not plain JSON, or labels a dimension wrongly.
    """
    _check_names(layout, "attribute", attributes, list(layout.attributes))
    plain: dict[str, Any] = json.loads(canonical_json(dict(attributes)))
    sizes = {
        dim: size
        for array in (*layout.coordinates, *layout.arrays)
        if array.name in arrays
        for dim, size in zip(array.dims, arrays[array.name].shape, strict=True)
    }
    for name in plain.keys() & sizes.keys():
        value = plain[name]
        if not isinstance(value, list) or len(value) != sizes[name]:
            raise InputError(
                f"{layout.stage}: attribute {name}",
                expected=f"a list of {sizes[name]} labels, one for each {name}",
                found=f"{len(value)} of them" if isinstance(value, list) else repr(value),
                todo=f"Give the labels in the order of the {name} dimension.",
            )
    return {name: plain[name] for name in layout.attributes if name in plain}


def _check_names(
    layout: GroupLayout, kind: str, given: Mapping[str, Any], known: list[str]
) -> None:
    unknown = sorted(given.keys() - set(known))
    absent = sorted(set(known) - given.keys() - set(layout.optional))
    if unknown or absent:
        raise InputError(
            f"{layout.stage}: {kind}s",
            expected=", ".join(known) or "none",
            found=f"unknown: {', '.join(unknown) or 'none'}; absent: {', '.join(absent) or 'none'}",
            todo=f"Write the {kind}s that the layout in data_contracts names.",
        )


def _check_form(where: str, array: ArrayLayout, values: NDArray[Any]) -> None:
    if values.dtype != np.dtype(array.dtype):
        raise InputError(
            where,
            expected=f"dtype {array.dtype}",
            found=f"dtype {values.dtype}",
            todo="Convert it where its range and precision are known.",
        )
    if values.ndim != len(array.dims):
        raise InputError(
            where,
            expected=f"dimensions ({', '.join(array.dims)})",
            found=f"shape {values.shape}",
            todo="Reshape it; dimensions are never guessed.",
        )


def _checked_values(where: str, array: ArrayLayout, values: NDArray[Any]) -> NDArray[Any]:
    if values.dtype.kind == "f":
        absent = np.isnan(values)
        wrong = np.isinf(values) if array.missing == "nan" else ~np.isfinite(values)
        if absent.any() and array.missing == "nan":
            # NaNs come with a sign and a payload that depend on the processor's path.
            values = np.where(absent, values.dtype.type(np.nan), values)
    else:
        wrong = values < -1 if array.missing == "-1" else np.zeros((), dtype=np.bool_)
    if wrong.any():
        place = tuple(int(index) for index in np.argwhere(wrong)[0])
        allowed = {"nan": "finite numbers or NaN", "-1": "indices from 0, or -1 for missing"}
        raise InputError(
            f"{where}{list(place)}",
            expected=allowed.get(array.missing, "finite numbers only"),
            found=f"{values[place]}, and {int(wrong.sum())} such in all",
            todo="Mark what is missing as the layout says, or find out why it is not finite.",
        )
    return values
