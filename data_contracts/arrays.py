"""Layouts of stored arrays: dimensions, dtype, unit, chunk and missing value.

A layout is checked when a result is written and travels with the array as attributes, so that a
reader needs no other source to know what the numbers are.
"""

from __future__ import annotations

import re
import textwrap
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from data_contracts.records import CONTRACT_VERSION, Name, Record

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
AnyFloats = NDArray[np.floating]
"""Floating-point numbers of single or double precision."""
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]


class ClipArray(Protocol):
    """An array that can be read by frames, its first dimension; NumPy's arrays can."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape, with frames first."""

    def __getitem__(self, frames: slice | Integers, /) -> NDArray[Any]:
        """Return the values of some frames."""


def find_runs(flags: NDArray[np.bool_]) -> list[slice]:
    """Return the intervals in which flags (n,) are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


Missing = Literal["nan", "-1", "0", "none"]

CHUNK_BYTES = 1 << 20
"""Minimum size of a full chunk before compression [byte]: smaller chunks halve the throughput."""
SHARD_CHUNKS = 64
"""Maximum number of chunks per file: a writer holds all chunks of a file in memory."""


class ArrayLayout(Record):
    """One array of a result."""

    name: Name
    dims: tuple[str, ...]
    """Dimension names in storage order; a dimension that names a coordinate is labelled by it."""
    dtype: Literal["float64", "float32", "int64", "int32", "int16", "uint8", "bool"]
    unit: str
    """m, px, rad, s, m^2, frame, or 1 for a pure number."""
    missing: Missing
    about: str
    """Meaning of the numbers, with their coordinate frame."""
    chunk_dim: str | None = None
    """The dimension that is cut into chunks of at least `CHUNK_BYTES`; None = one chunk."""

    def chunks(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Chunk shape for an array of `shape`, whole except along `chunk_dim`."""
        whole = tuple(max(1, n) for n in shape)
        if self.chunk_dim is None:
            return whole
        axis = self.dims.index(self.chunk_dim)
        row_bytes = np.dtype(self.dtype).itemsize * int(np.prod(whole)) // whole[axis]
        rows = -(-CHUNK_BYTES // max(1, row_bytes))
        return (*whole[:axis], min(whole[axis], rows), *whole[axis + 1 :])

    def shards(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of one file's part of an array of `shape`: as few whole chunks as files allow."""
        chunks = self.chunks(shape)
        if self.chunk_dim is None:
            return chunks
        axis = self.dims.index(self.chunk_dim)
        number = max(1, -(-shape[axis] // chunks[axis]))
        files = -(-number // SHARD_CHUNKS)
        length = -(-number // files) * chunks[axis]
        return (*chunks[:axis], length, *chunks[axis + 1 :])

    def attributes(self) -> dict[str, Any]:
        """Attributes stored with the array."""
        return {"unit": self.unit, "missing": self.missing, "about": self.about}


_FORM = re.compile(r"\(([\w, *]*)\) (\w+) \[([^\]]+)\](?:, missing (\S+))?")


def array_layout(name: str, form: str, about: str) -> ArrayLayout:
    """Return the layout of an array.

    The form has dimensions, type, unit and missing value, such as
    `(*frame, person, joint) float32 [px], missing nan`; a star marks `chunk_dim`.

    Raises:
        ValueError: the form is not of this kind, or has an unknown type or missing value.
    """
    found = _FORM.fullmatch(form)
    if found is None:
        raise ValueError(f"array {name}: not the form of an array: {form!r}")
    dims = [dim for dim in found[1].split(", ") if dim]
    return ArrayLayout.model_validate(
        {
            "name": name,
            "dims": tuple(dim.removeprefix("*") for dim in dims),
            "dtype": found[2],
            "unit": found[3],
            "missing": found[4] or "none",
            "about": about,
            "chunk_dim": next((dim[1:] for dim in dims if dim.startswith("*")), None),
        }
    )


def array_layouts(table: str) -> tuple[ArrayLayout, ...]:
    """Return the layouts of a table.

    Each array has a line with its name, the form of `array_layout` and a colon. Indented lines
    below it state the meaning of its numbers.
    """
    layouts = []
    for entry in re.split(r"\n(?=\S)", textwrap.dedent(table).strip()):
        head, _, about = entry.partition(":\n")
        name, _, form = head.partition(" ")
        layouts.append(array_layout(name, form, " ".join(about.split())))
    return tuple(layouts)


class GroupLayout(Record):
    """All arrays of one stage's result, and the labels of its dimensions."""

    contract: int = CONTRACT_VERSION
    stage: Name
    about: str
    arrays: tuple[ArrayLayout, ...]
    coordinates: tuple[ArrayLayout, ...] = ()
    """One-dimensional arrays named as their dimension: frame numbers, person ids."""
    labels: dict[str, tuple[str, ...]] = {}
    """Dimensions with fixed names, such as joint = COCO-17."""
    attributes: dict[str, str] = {}
    """Group attributes that a writer must give, with their meaning."""
    optional: tuple[str, ...] = ()
    """Names of arrays and attributes that may be absent."""

    def layout(self, name: str) -> ArrayLayout:
        """The layout of the array or coordinate `name`.

        Raises:
            KeyError: the group has no such array.
        """
        for array in (*self.coordinates, *self.arrays):
            if array.name == name:
                return array
        raise KeyError(f"{self.stage} has no array {name!r}")
