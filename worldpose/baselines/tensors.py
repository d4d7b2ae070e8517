"""Torch tensors from zip files, older files and plain pickles, read without torch.

A tensor is a view of a storage: an offset, lengths and strides, all of which are checked against
the size of the storage.
"""

from __future__ import annotations

import io
import math
import pickle
import struct
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worldpose.pickles import LARGEST, Note

Storages = Callable[[object], object]
"""Returns the storage for a persistent id of a file."""
Load = Callable[[io.BytesIO, Storages], Any]
"""Reads one pickle from a stream."""

_TYPES: Final = {
    "Double": "f8",
    "Float": "f4",
    "Half": "f2",
    "Long": "i8",
    "Int": "i4",
    "Short": "i2",
    "Char": "i1",
    "Byte": "u1",
    "Bool": "b1",
}
_MAGIC: Final = 0x1950A86A20F9469CFC6C
"""First pickle of torch's older files."""


class Tensor(Note):
    """`_rebuild_tensor_v2`: storage, offset, lengths, strides."""


class Parameter(Note):
    """`_rebuild_parameter`: a tensor and whether it is trained."""


class Saved(Note):
    """`_load_from_bytes`: an older file within a pickle, with one storage."""


def _storage_type(code: str) -> type[Note]:
    return type(f"Storage_{code}", (Note,), {"code": code})


_STORAGES: Final = {
    ("torch", f"{name}Storage"): _storage_type(code) for name, code in _TYPES.items()
}
ALLOWED: Final[Mapping[tuple[str, str], type[Note]]] = {
    **_STORAGES,
    ("torch._utils", "_rebuild_tensor_v2"): Tensor,
    ("torch._utils", "_rebuild_parameter"): Parameter,
    ("torch.storage", "_load_from_bytes"): Saved,
}
"""Names of torch that a file can use."""


def open_archive(file: zipfile.ZipFile, limit: int) -> tuple[io.BytesIO, Storages]:
    """Return the pickle of a torch zip file, and a function that returns its storages.

    Args:
        file: the zip file.
        limit: maximum unpacked size of its members [byte].

    Raises:
        ValueError: it is not such a file, too large, or of another byte order.
    """
    names = [name for name in file.namelist() if name.endswith("/data.pkl")]
    if len(names) != 1:
        raise ValueError("a zip file that torch did not write")
    if sum(info.file_size for info in file.infolist()) > limit:
        raise ValueError("a file that is too large")
    root = names[0].removesuffix("data.pkl")
    if f"{root}byteorder" in file.namelist() and file.read(f"{root}byteorder") != b"little":
        raise ValueError("another byte order than little")

    def storage(identity: object) -> object:
        kind, key, _ = _identity(identity)
        return _flat(kind, file.read(f"{root}data/{key}"))

    return io.BytesIO(file.read(names[0])), storage


def decoders(load: Load) -> Mapping[type[Note], Callable[[Any], object]]:
    """Return the decoders of torch's notes.

    Args:
        load: reads a pickle.
    """

    def storage(value: object) -> NDArray[Any]:
        if isinstance(value, Saved):
            return _older(io.BytesIO(value.args[0]), load)
        if not isinstance(value, np.ndarray):
            raise ValueError("a tensor without numbers")
        return value

    def tensor(note: Tensor) -> object:
        first, lengths, steps = note.args[1:4]
        return _view(storage(note.args[0]), int(first), list(lengths), list(steps))

    def parameter(note: Parameter) -> object:
        inner = note.args[0]
        if not isinstance(inner, Tensor):
            raise ValueError("a parameter without a tensor")
        return tensor(inner)

    return {Tensor: tensor, Parameter: parameter}


def _identity(identity: object) -> tuple[str, str, int]:
    """Return type, key and length of a storage from its persistent id."""
    if not isinstance(identity, tuple) or len(identity) < 5 or identity[0] != "storage":
        raise pickle.UnpicklingError("an object kept outside the file")
    kind, key, _, count = identity[1:5]
    if kind not in _STORAGES.values():
        raise pickle.UnpicklingError("a storage of an unknown type")
    return str(kind.code), str(key), int(count)


def _flat(code: str, raw: bytes) -> NDArray[Any]:
    kind = np.dtype(f"<{code}")
    return np.frombuffer(raw[: len(raw) // kind.itemsize * kind.itemsize], kind)


def _view(flat: NDArray[Any], first: int, lengths: list[int], steps: list[int]) -> NDArray[Any]:
    """Return a copy of the elements of a storage that a tensor views."""
    if len(lengths) != len(steps) or first < 0 or any(n < 0 for n in (*lengths, *steps)):
        raise ValueError(f"a tensor of lengths {lengths} and steps {steps}")
    if 0 in lengths:
        return np.empty(lengths, flat.dtype)
    last = first + sum((n - 1) * step for n, step in zip(lengths, steps, strict=True))
    if last >= len(flat) or math.prod(lengths) > LARGEST:
        raise ValueError(f"a tensor of lengths {lengths} on {len(flat)} numbers")
    strides = [step * flat.itemsize for step in steps]
    view: NDArray[Any] = np.lib.stride_tricks.as_strided(flat[first:], lengths, strides)
    return view.copy()


def _older(stream: io.BytesIO, load: Load) -> NDArray[Any]:
    """Read the one storage of a file in torch's older format: five pickles, then the bytes."""
    types: dict[str, tuple[str, int]] = {}

    def named(identity: object) -> object:
        kind, key, count = _identity(identity)
        types[key] = (kind, count)
        return key

    if load(stream, named) != _MAGIC:
        raise ValueError("a storage in an unknown form")
    load(stream, named)
    load(stream, named)
    load(stream, named)
    keys = load(stream, named)
    if len(types) != 1 or list(keys) != list(types):
        raise ValueError("several storages in one")
    code, count = types[keys[0]]
    written = struct.unpack("<q", stream.read(8))[0]
    flat = _flat(code, stream.read(count * np.dtype(code).itemsize))
    if written != count or len(flat) != count:
        raise ValueError(f"{len(flat)} of {count} numbers")
    return flat
