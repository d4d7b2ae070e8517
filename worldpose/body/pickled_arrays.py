"""Arrays of a pickle, read without running anything that the pickle names.

A pickle is a program whose instructions call whatever the file names. Here every name that SMPL's
files need leads to a class of this file that only notes what it is given, and every other name
ends the reading. So nothing is imported and no foreign code runs; after the reading the notes are
checked and turned into arrays. Neither chumpy nor scipy's own unpickling is involved.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Literal, Self, cast

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from worldpose.body.body_file import unreadable

_NUMBERS: Final = re.compile(r"b1|[iu][1248]|f[248]")
_MALFORMED: Final = (
    *(ArithmeticError, AttributeError, LookupError, TypeError, ValueError),
    *(MemoryError, RecursionError),
)
_LARGEST: Final = 1 << 28
"""Most elements of a dense array: three times the pose directions with 300 shapes."""


class _Note:
    """Notes the arguments and the state that a pickle gives to some class."""

    args: tuple[Any, ...]
    state: Any

    # Pickles make objects both by calling the class and by __new__ alone.
    def __new__(cls, *args: object, **_: object) -> Self:
        note = super().__new__(cls)
        note.args, note.state = args, None
        return note

    def __init__(self, *_: object, **__: object) -> None:
        pass

    # Without it, the unpickler would set attributes of its own choice.
    def __setstate__(self, state: object) -> None:
        self.state = state


class _Array(_Note):
    """numpy's `_reconstruct`: the content comes as the state."""


class _Buffer(_Note):
    """numpy's `_frombuffer`, used by protocol 5."""


class _Dtype(_Note):
    """numpy's `dtype`."""


class _Encoded(_Note):
    """`_codecs.encode`, how Python 3 writes bytes for Python 2; empty ones are plain `bytes`."""


class _Sparse(_Note):
    """A sparse matrix with compressed columns."""


class _SparseRows(_Sparse):
    """A sparse matrix with compressed rows."""


class _Chumpy(_Note):
    """An array inside an object of chumpy."""


class _Reconstructor(_Note):
    """`copyreg._reconstructor`: makes an object of the class it is given, here always a note."""

    def __new__(cls, kind: object = None, *_: object) -> _Note:  # type: ignore[misc]
        if not (isinstance(kind, type) and issubclass(kind, _Note)):
            raise pickle.UnpicklingError("an object of an unknown class")
        return _Note.__new__(kind)


class _Ignored(_Note):
    """What has no part in the arrays."""


_ALLOWED: Final[Mapping[tuple[str, str], type[_Note]]] = {
    ("numpy", "ndarray"): _Ignored,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Encoded,
    ("copyreg", "_reconstructor"): _Reconstructor,
    ("copy_reg", "_reconstructor"): _Reconstructor,
    ("builtins", "object"): _Ignored,
    ("__builtin__", "object"): _Ignored,
    ("builtins", "set"): _Ignored,
    ("__builtin__", "set"): _Ignored,
    ("builtins", "bytes"): _Encoded,
    ("__builtin__", "bytes"): _Encoded,
    **{
        (f"numpy.{core}.{module}", name): note
        for core in ("core", "_core")
        for module, name, note in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _Ignored),
            ("numeric", "_frombuffer", _Buffer),
        )
    },
    **{
        (f"scipy.sparse.{module}", f"{kind}_matrix"): note
        for kind, note in (("csc", _Sparse), ("csr", _SparseRows))
        for module in (kind, f"_{kind}")
    },
}
"""Names that a pickle may use, and the class that stands for each."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_Note]:
        if module == "chumpy" or module.startswith("chumpy."):
            return _Chumpy
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"the name {module}.{name}, which is not allowed")
        return _ALLOWED[module, name]


def read_pickled_arrays(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Return arrays of a pickled dictionary, dense also where the pickle holds sparse ones.

    Raises:
        InputError: the file cannot be read, names anything but arrays, or lacks a key.
    """
    try:
        stream = path.read_bytes()
        _check_memory(stream)
        # Python 2 wrote the bytes of arrays as text.
        content = _Unpickler(io.BytesIO(stream), encoding="latin1").load()
    except OSError as error:
        raise unreadable(path, f"what cannot be read ({error})") from None
    # A damaged pickle can fail in any way: the documentation of pickle names no closed list.
    except Exception as error:
        raise unreadable(path, f"what cannot be read as a pickle ({_reason(error)})") from None
    if not isinstance(content, dict):
        raise unreadable(path, f"a pickled {type(content).__name__.strip('_').lower()}")
    lacking = [key for key in keys if key not in content]
    if lacking:
        raise unreadable(path, f"none named {', '.join(lacking)}")
    arrays = {}
    for key in keys:
        try:
            arrays[key] = _array(content[key])
        # The notes hold whatever the file says, of any type.
        except _MALFORMED as bad:
            raise unreadable(path, f"{key} that is not an array ({_reason(bad)})") from None
    return arrays


def _check_memory(stream: bytes) -> None:
    """Refuse sizes and numbers beyond the file's own length, which would fill the memory.

    Raises:
        ValueError: the file is truncated, or numbers a memorised object higher than its length.
    """
    for opcode, argument, _ in pickletools.genops(stream):
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and cast(int, argument) > len(stream):
            raise ValueError(f"a memorised object number {argument}")


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__


def _array(value: object) -> NDArray[np.generic]:
    for kind, decoded in _DECODERS.items():
        if isinstance(value, kind):
            return decoded(value)
    raise ValueError(f"a {type(value).__name__}")


def _plain_array(note: _Array) -> NDArray[np.generic]:
    _, shape, dtype, fortran, raw = note.state
    return _numbers(raw, dtype, shape, "F" if fortran else "C")


def _buffer_array(note: _Buffer) -> NDArray[np.generic]:
    raw, dtype, shape, order = note.args
    return _numbers(raw, dtype, shape, "F" if order == "F" else "C")


def _numbers(
    raw: object, dtype: _Dtype, shape: Iterable[int], order: Literal["C", "F"]
) -> NDArray[np.generic]:
    """Bytes as an array; `frombuffer` and `reshape` refuse sizes that do not fit."""
    if isinstance(raw, _Encoded):
        text, encoding = raw.args or ("", "latin1")
        if encoding not in ("latin1", "latin-1"):
            raise ValueError(f"bytes written as {encoding}")
        raw = text
    code, byte_order = dtype.args[0], dtype.state[1]
    if not _NUMBERS.fullmatch(code) or byte_order not in "<>|=":
        raise ValueError(f"elements of type {code!r}")
    content = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(content, bytes | bytearray):
        raise ValueError(f"a {type(raw).__name__} for its bytes")
    flat: NDArray[np.generic] = np.frombuffer(content, np.dtype(byte_order + code))
    return flat.reshape([int(length) for length in shape], order=order)


def _sparse_array(note: _Sparse) -> NDArray[np.generic]:
    parts = [_array(note.state[name]) for name in ("data", "indices", "indptr")]
    shape = tuple(int(length) for length in note.state["_shape"])
    if math.prod(shape) > _LARGEST:
        raise ValueError(f"a sparse matrix of shape {shape}")
    made = scipy.sparse.csr_array if isinstance(note, _SparseRows) else scipy.sparse.csc_array
    matrix = made(tuple(parts), shape=shape)
    # scipy's own code writes wherever the indices point.
    matrix.check_format(full_check=True)
    dense: NDArray[np.generic] = matrix.toarray()
    return dense


def _chumpy_array(note: _Chumpy) -> NDArray[np.generic]:
    """An array that chumpy wraps (`x`), or one picked out of another (`a`, `idxs`)."""
    if "x" in note.state:
        return _array(note.state["x"])
    picked: NDArray[np.generic] = _array(note.state["a"]).ravel()[_array(note.state["idxs"])]
    shape = note.state.get("preferred_shape")
    return picked if shape is None else picked.reshape([int(length) for length in shape])


_DECODERS: Final[Mapping[type[_Note], Callable[[Any], NDArray[np.generic]]]] = {
    _Array: _plain_array,
    _Buffer: _buffer_array,
    _Sparse: _sparse_array,
    _Chumpy: _chumpy_array,
}
