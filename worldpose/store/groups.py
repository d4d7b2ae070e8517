"""Arrays of a result: checked against their layout, written as one Zarr group, and read again."""

from __future__ import annotations

import asyncio
import json
import mmap
import os
import warnings
from collections.abc import AsyncIterator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import google_crc32c
import numpy as np
import xarray as xr
import zarr
from numcodecs.blosc import Blosc
from numpy.typing import NDArray
from zarr.abc.store import (
    ByteRequest,
    OffsetByteRequest,
    RangeByteRequest,
    Store,
    SuffixByteRequest,
)
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.errors import ZarrUserWarning
from zarr.storage import LocalStore

from data_contracts.arrays import CHUNK_BYTES, ArrayLayout, GroupLayout
from data_contracts.conventions import CONVENTIONS
from data_contracts.run import ResultManifest, StoredFile
from worldpose.errors import InputError, InternalError
from worldpose.store.blobs import Blobs, LocalBlobs
from worldpose.store.documents import canonical_json, corruption_error, read_published
from worldpose.store.paths import ResultId

Arrays = Mapping[str, NDArray[Any]]

# xarray imports Dask on its first use. Dask's modules import each other in a circle, and two
# threads that enter it at different places fail. Only one thread imports this module.
xr.Variable((), 0).chunksizes  # noqa: B018

CODEC: Final[dict[str, Any]] = {"cname": "lz4", "clevel": 5}
"""Compression of chunks by Blosc."""


def checked_arrays(
    layout: GroupLayout, arrays: Arrays, coordinates: Arrays
) -> dict[str, NDArray[Any]]:
    """Return all arrays by name in the layout's order, unchanged.

    InternalError if an array is unknown, absent, of another dtype or dimension, disagrees with
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
    """Return the slices of an array's consecutive parts, one file each: it may exceed memory."""
    if 0 in shape:
        return []
    whole = tuple(slice(0, size) for size in shape)
    if array.chunk_dim is None:
        return [whole]
    axis = array.dims.index(array.chunk_dim)
    size, length = shape[axis], array.shards(shape)[axis]
    return [
        (*whole[:axis], slice(first, min(first + length, size)), *whole[axis + 1 :])
        for first in range(0, size, length)
    ]


def release_memory(values: NDArray[Any]) -> None:
    """Give back the memory of an array that lies in a file; its parts are read again on access."""
    base: Any = values
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)


def normalize_nans(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values with one bit pattern for every NaN, which processors write with several."""
    if values.dtype.kind != "f":
        return values
    return np.where(np.isnan(values), values.dtype.type(np.nan), values)


def checked_attributes(
    layout: GroupLayout, arrays: Arrays, attributes: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the group's attributes as plain JSON, in the layout's order.

    An attribute with the name of a dimension is a list that labels it, of the dimension's size.
    InternalError for another list, and if one is unknown, absent or not plain JSON.
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
            found = f"{len(value)} labels" if isinstance(value, list) else repr(value)
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
        release_memory(values)
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
            f"{where}{list(first)}",
            f"expected {expected}, found {value}; {number} values in all are wrong",
        )


def _wrong_values(array: ArrayLayout, values: NDArray[Any]) -> NDArray[np.bool_]:
    wrong: NDArray[np.bool_] = np.zeros((), dtype=np.bool_)
    if values.dtype.kind == "f":
        wrong = np.isinf(values) if array.missing == "nan" else ~np.isfinite(values)
    elif array.missing == "-1":
        wrong = values < -1
    return wrong


class PublishedFiles(Store):
    """Read-only Zarr store that raises an error for a lost or changed file, never a fill value.

    A read of a whole file is verified by its SHA-256. A read of a part, a chunk or the index of all
    chunks, reads this part alone, and is verified by the CRC-32C at its end.
    """

    supports_writes = False
    supports_deletes = False
    supports_listing = True

    def __init__(self, blobs: Blobs, result: ResultId, manifest: ResultManifest) -> None:
        super().__init__(read_only=True)
        self._blobs, self._result = blobs, result
        self._files = {file.path: file for file in manifest.files}
        self._ends: dict[tuple[str, int], bytes] = {}
        """Ends of files that were read, by path and length: the index of their chunks."""

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, PublishedFiles)
            and (self._blobs.url, self._result) == (other._blobs.url, other._result)
            and self._files == other._files
        )

    def __repr__(self) -> str:
        return f"PublishedFiles({self._blobs.url}/{self._result.path})"

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the file `key` or a range of it, None if the result has no such file."""
        file = self._files.get(key)
        if file is None:
            return None
        size = file.size
        match byte_range:
            case RangeByteRequest(start, stop):
                pass
            case OffsetByteRequest(start):
                stop = size
            case SuffixByteRequest(suffix):
                start, stop = max(0, size - suffix), size
                if (key, suffix) not in self._ends:
                    self._ends[key, suffix] = await asyncio.to_thread(self._read, file, start, stop)
                return prototype.buffer.from_bytes(self._ends[key, suffix])
            case _:
                start, stop = 0, size
        # A thread for each chunk of a local file would take longer than its few reads save.
        if isinstance(self._blobs, LocalBlobs) and stop - start <= 2 * CHUNK_BYTES:
            data = self._read(file, start, stop)
        else:
            data = await asyncio.to_thread(self._read, file, start, stop)
        return prototype.buffer.from_bytes(data)

    def _read(self, file: StoredFile, start: int, stop: int) -> bytes:
        if start == 0 and stop >= file.size:
            return read_published(self._blobs, self._result, file)
        path = f"{self._result.path}/{file.path}"
        data = self._blobs.read_range(path, start, stop)
        if data is None:
            raise corruption_error(self._blobs, path, "the file is missing")
        if len(data) != stop - start or _crc32c(data[:-4]) != data[-4:]:
            found = f"the CRC-32C of its part at byte {start} does not match"
            raise corruption_error(self._blobs, path, found)
        return data

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Return ranges of several files."""
        return [await self.get(key, prototype, part) for key, part in key_ranges]

    async def exists(self, key: str) -> bool:
        """Return whether the manifest names the file `key`."""
        return key in self._files

    async def set(self, key: str, value: Buffer) -> None:
        """Raise an error: a published result never changes."""
        self._check_writable()

    async def delete(self, key: str) -> None:
        """Raise an error: a published result never changes."""
        self._check_writable()

    async def list(self) -> AsyncIterator[str]:
        """Yield every file."""
        for key in self._files:
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield every file whose path starts with `prefix`."""
        for key in self._files:
            if key.startswith(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Yield names of files and folders directly inside the folder `prefix`."""
        base = f"{prefix.rstrip('/')}/" if prefix.strip("/") else ""
        inside = (key[len(base) :] for key in self._files if key.startswith(base))
        for name in dict.fromkeys(key.split("/")[0] for key in inside):
            yield name


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
    """Write the group to an empty folder; return the number of files.

    Equal arrays and attributes give equal files. Chunks are lz4 with a CRC-32C of the compressed
    bytes, so that any Zarr reader refuses a changed chunk. Empty chunks are written, too: a lost
    chunk never becomes a fill value. A file holds up to `SHARD_CHUNKS` chunks of an array (Zarr's
    sharding), and is written whole. Coordinates are one-dimensional. InternalError if arrays, of
    which those in `layout.optional` can be absent, or attributes do not match the layout.
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
        chunks, shards = array.chunks(values.shape), array.shards(values.shape)
        stored = group.create_array(
            name,
            shape=values.shape,
            chunks=chunks,
            shards=shards if shards != chunks else None,
            dtype=values.dtype,
            fill_value=_fill_value(array),
            dimension_names=array.dims,
            compressors=[BloscCodec(**CODEC, shuffle="shuffle"), Crc32cCodec()],
            attributes=array.attributes(),
            config={"write_empty_chunks": True},
        )
        files += 1
        for number, part in enumerate(array_parts(array, values.shape)):
            place = ["0"] * values.ndim
            if array.chunk_dim is not None:
                place[array.dims.index(array.chunk_dim)] = str(number)
            path = "/".join([name, "c", *place])
            if shards == chunks:
                stored[part] = normalize_nans(values[part])
            else:
                _write_shard(folder / path, array, values[part], values.shape)
            files += 1
            release_memory(values)
    # Zarr warns that other readers may ignore it, as the format allows. Not in `catch_warnings`,
    # whose end in one thread would end it in others, which write at the same time.
    warnings.filterwarnings("ignore", "Consolidated metadata", ZarrUserWarning)
    # If another process has removed files meanwhile, their number reveals it.
    with suppress(FileNotFoundError):
        # For readers that open the folder themselves: they list it otherwise, and warn.
        zarr.consolidate_metadata(group.store)
    return files


def _write_shard(
    file: Path, array: ArrayLayout, values: NDArray[Any], shape: tuple[int, ...]
) -> None:
    """Write one new file of an array of `shape`, with its part `values`, as Zarr's sharding does.

    Zarr itself would hold a file's chunks three times in memory, at twice the time. The file has
    the chunks in order, each with its CRC-32C, then the index of their places with its CRC-32C.
    """
    # Place and size of a chunk beyond the end of an array in the index of a file.
    no_chunk = (1 << 64) - 1
    assert array.chunk_dim is not None
    axis = array.dims.index(array.chunk_dim)
    length = array.chunks(shape)[axis]
    codec = Blosc(**CODEC, shuffle=Blosc.SHUFFLE)

    def encode(first: int) -> bytes:
        part = (*(slice(None),) * axis, slice(first, first + length))
        chunk = normalize_nans(values[part])
        missing = length - chunk.shape[axis]
        if missing:
            widths = [(0, missing if dim == axis else 0) for dim in range(values.ndim)]
            chunk = np.pad(chunk, widths, constant_values=_fill_value(array))
        coded = bytes(codec.encode(np.ascontiguousarray(chunk)))
        return coded + _crc32c(coded)

    index = np.full((array.shards(shape)[axis] // length, 2), no_chunk, dtype="<u8")
    file.parent.mkdir(parents=True, exist_ok=True)
    # Not in the main thread: there Blosc uses threads of its own, which change the bytes.
    with file.open("xb") as out, ThreadPoolExecutor(os.cpu_count()) as threads:
        for number, chunk in enumerate(threads.map(encode, range(0, values.shape[axis], length))):
            index[number] = out.tell(), len(chunk)
            out.write(chunk)
        coded = index.tobytes()
        out.write(coded + _crc32c(coded))


def _crc32c(data: bytes) -> bytes:
    return int(google_crc32c.value(data)).to_bytes(4, "little")


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
