"""Notes for the classes of a pickle, and their conversion to plain data."""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable, Mapping
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

LARGEST: Final = 1 << 30
"""Maximum number of elements of one array: 1 GB of bytes; no array holds an hour of 25 surfaces."""

_TYPES: Final = re.compile(r"b1|[iu][1248]|f[248]|[US]\d{1,5}")


class Note:
    """Records the arguments and the state that a pickle passes to a class."""

    args: tuple[Any, ...]
    state: Any

    # Pickles create objects both by calling the class and by __new__ alone.
    def __new__(cls, *args: object, **_: object) -> Self:  # noqa: D102
        note = super().__new__(cls)
        note.args, note.state = args, None
        return note

    def __init__(self, *_: object, **__: object) -> None:
        pass

    # Without it, the unpickler would set attributes that the file chooses.
    def __setstate__(self, state: object) -> None:
        self.state = state


class Array(Note):
    """numpy's `_reconstruct`: the content comes as the state."""


class Buffer(Note):
    """numpy's `_frombuffer`, used by protocol 5."""


class Dtype(Note):
    """numpy's `dtype`."""


class Scalar(Note):
    """numpy's `scalar`: a type and its bytes."""


class Encoded(Note):
    """`_codecs.encode`, Python 3's encoding of bytes for Python 2; empty ones are plain `bytes`."""


class Kind(Note):
    """A class that is only named, such as the type of an array."""


class Reconstructor(Note):
    """`copyreg._reconstructor`: creates an object of the given class, here always a note."""

    def __new__(cls, kind: object = None, *_: object) -> Note:  # type: ignore[misc]  # noqa: D102
        if not (isinstance(kind, type) and issubclass(kind, Note)):
            raise pickle.UnpicklingError("an object of an unknown class")
        return Note.__new__(kind)


class Table(dict[Any, Any]):
    """A dictionary of any class; other state of the class is dropped."""

    def __new__(cls, *_: object, **__: object) -> Self:  # noqa: D102
        return super().__new__(cls)

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__()

    def __setstate__(self, state: object) -> None:
        pass


ALLOWED: Final[Mapping[tuple[str, str], type[Any]]] = {
    ("numpy", "ndarray"): Kind,
    ("numpy", "dtype"): Dtype,
    ("_codecs", "encode"): Encoded,
    ("copyreg", "_reconstructor"): Reconstructor,
    ("copy_reg", "_reconstructor"): Reconstructor,
    ("collections", "OrderedDict"): Table,
    ("collections", "defaultdict"): Table,
    **{
        (module, name): kind
        for module in ("builtins", "__builtin__")
        for name, kind in (
            *(("dict", Table), ("bytes", Encoded)),
            *((name, Kind) for name in ("object", "list", "int", "float", "set")),
        )
    },
    **{
        (f"numpy.{core}.{module}", name): note
        for core in ("core", "_core")
        for module, name, note in (
            ("multiarray", "_reconstruct", Array),
            ("multiarray", "scalar", Scalar),
            ("numeric", "_frombuffer", Buffer),
        )
    },
}
"""Names allowed in any pickle, and the class that replaces each."""


def plain(value: object, decoders: Mapping[type[Note], Callable[[Any], object]]) -> Any:  # noqa: ANN401
    """Convert notes to arrays; return dictionaries, lists, numbers, text and arrays.

    Args:
        value: output of the unpickler.
        decoders: additional note classes and their conversions.

    Raises:
        ValueError: a malformed note, or an object that contains itself.
    """
    return _Plain({**_DECODERS, **decoders}).of(value)


class _Plain:
    def __init__(self, decoders: Mapping[type[Note], Callable[[Any], object]]) -> None:
        self._decoders = decoders
        # Shared objects are converted once: nested sharing would otherwise grow without bound. The
        # original is kept so that its address is not reused for another object.
        self._done: dict[int, tuple[object, Any]] = {}
        self._open: set[int] = set()

    def of(self, value: object) -> Any:  # noqa: ANN401
        if value is None or isinstance(value, bool | int | float | str | bytes):
            return value
        place = id(value)
        if place in self._done:
            return self._done[place][1]
        if place in self._open:
            raise ValueError("something that holds itself")
        self._open.add(place)
        turned = self._turned(value)
        self._open.discard(place)
        self._done[place] = (value, turned)
        return turned

    def _turned(self, value: object) -> object:
        if isinstance(value, dict):
            return {_key(self.of(key)): self.of(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self.of(item) for item in value]
        if isinstance(value, np.ndarray):
            return value
        for kind, decoded in self._decoders.items():
            if isinstance(value, kind):
                found = decoded(value)
                return self.of(found) if isinstance(found, list | dict) else found
        # State without a plain equivalent, such as a generator's.
        return None


def _key(value: object) -> object:
    """Convert lists, which tuples become, to valid keys."""
    return tuple(value) if isinstance(value, list) else value


def type_of(note: object) -> np.dtype[Any]:
    """Return the numpy type of a note, for numbers and text only.

    Raises:
        ValueError: it is another type.
    """
    if not isinstance(note, Dtype) or not note.args:
        raise ValueError("an array without a type")
    code = note.args[0]
    order = note.state[1] if note.state else "="
    if not isinstance(code, str) or not _TYPES.fullmatch(code) or order not in ("<", ">", "|", "="):
        raise ValueError(f"elements of type {code!r}")
    return np.dtype(("" if order == "|" else order) + code)


def numbers(raw: object, kind: np.dtype[Any], shape: object, order: str) -> NDArray[Any]:
    """Return bytes as an array; sizes must match.

    Raises:
        ValueError: not bytes, or another number of them.
    """
    if isinstance(raw, Encoded):
        text, encoding = raw.args or ("", "latin1")
        if encoding not in ("latin1", "latin-1"):
            raise ValueError(f"bytes written as {encoding}")
        raw = text
    content = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(content, bytes | bytearray) or not isinstance(shape, tuple | list):
        raise ValueError(f"a {type(raw).__name__} for its bytes")
    lengths = [int(length) for length in shape]
    if math.prod(lengths) * kind.itemsize != len(content) or any(n < 0 for n in lengths):
        raise ValueError(f"{len(content)} bytes for the shape {tuple(lengths)}")
    flat: NDArray[Any] = np.frombuffer(content, kind)
    return flat.reshape(lengths, order="F" if order == "F" else "C")


def _array(note: Array) -> object:
    _, shape, dtype, fortran, raw = note.state
    if isinstance(dtype, Dtype) and dtype.args[0] == "O8":
        if not isinstance(raw, list) or math.prod(shape) != len(raw) or len(shape) > 1:
            raise ValueError(f"objects of shape {shape}")
        return raw if shape else {"item": raw[0]}
    return numbers(raw, type_of(dtype), shape, "F" if fortran else "C")


def _buffer(note: Buffer) -> object:
    raw, dtype, shape, order = note.args
    return numbers(raw, type_of(dtype), shape, order)


def _scalar(note: Scalar) -> object:
    dtype, raw = note.args
    return numbers(raw, type_of(dtype), (1,), "C")[0].item()


_DECODERS: Final[Mapping[type[Note], Callable[[Any], object]]] = {
    Array: _array,
    Buffer: _buffer,
    Scalar: _scalar,
    Encoded: lambda note: numbers(note, np.dtype("u1"), (len((note.args or ("",))[0]),), "C"),
}
