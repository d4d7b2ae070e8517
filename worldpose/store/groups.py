"""A result's arrays as one Zarr group, and back as an xarray data set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.abc.store import Store
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.conventions import CONVENTIONS
from worldpose.store.layout_checks import (
    Arrays,
    array_parts,
    checked_arrays,
    checked_attributes,
    with_one_nan,
)


class _PrivateFolder(LocalStore):
    """Folder with one writer; creates files without hard links, which some file systems lack."""

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a file unless it exists; there is no concurrent writer."""
        if not await self.exists(key):
            await self.set(key, value)


def write_group(
    folder: Path,
    layout: GroupLayout,
    arrays: Arrays,
    coordinates: Arrays,
    attributes: Mapping[str, Any],
) -> int:
    """Write the group to `folder`; equal arrays and attributes give equal files.

    Chunks are lz4 with a CRC-32C of the compressed bytes, so that any Zarr reader refuses a changed
    chunk. Empty chunks are written, too: a lost chunk never becomes a fill value.

    Args:
        folder: an empty folder.
        layout: required form of the arrays.
        arrays: by name; those in `layout.optional` can be absent.
        coordinates: one-dimensional arrays by name.
        attributes: the attributes that `layout.attributes` requires.

    Returns:
        The number of files.

    Raises:
        InternalError: the arrays or attributes do not match the layout.
    """
    checked = checked_arrays(layout, arrays, coordinates)
    given = checked_attributes(layout, checked, attributes)
    group = zarr.create_group(
        store=_PrivateFolder(folder),
        zarr_format=3,
        attributes={
            "contract": layout.contract,
            "stage": layout.stage,
            "about": layout.about,
            "conventions": CONVENTIONS.model_dump(mode="json"),
            "labels": {dim: list(names) for dim, names in layout.labels.items()},
            "attributes": given,
        },
    )
    files = 1
    for name, values in checked.items():
        array = layout.layout(name)
        stored = group.create_array(
            name,
            shape=values.shape,
            chunks=array.chunks(values.shape),
            dtype=values.dtype,
            fill_value=_fill_value(array),
            dimension_names=array.dims,
            compressors=[BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()],
            attributes=array.attributes(),
            config={"write_empty_chunks": True},
        )
        for part in array_parts(array, values.shape):
            stored[part] = with_one_nan(values[part])
        files += 1 + stored.nchunks
    return files


def read_group(files: Store) -> xr.Dataset:
    """Open the group in `files`, read on access: labelled, with units and conventions."""
    stored: xr.Dataset = xr.open_zarr(
        files, zarr_format=3, consolidated=False, chunks=None, decode_cf=False
    )
    for variable in stored.variables.values():
        # xarray and its plots use "units".
        variable.attrs["units"] = variable.attrs.pop("unit")
    attributes = dict(stored.attrs)
    labels, given = attributes.pop("labels"), attributes.pop("attributes")
    named = {
        dim: names
        for dim, names in {**labels, **given}.items()
        if dim in stored.dims and dim not in stored.coords
    }
    others = {name: value for name, value in given.items() if name not in named}
    labelled = stored.assign_coords(named)
    labelled.attrs = {**attributes, **others}
    return labelled


def _fill_value(array: ArrayLayout) -> float | int | bool:
    """Return the value of a lost chunk for a reader without the manifest: missing, not a number."""
    kind = np.dtype(array.dtype).kind
    if kind == "f":
        return 0.0 if array.missing == "0" else np.nan
    if kind == "b":
        return False
    return -1 if array.missing == "-1" else 0
