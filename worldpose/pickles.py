"""Safe reading of untrusted files of pickle, joblib, numpy and torch, without executing them.

A pickle is a program whose instructions call any function that the file names. Here `ALLOWED` maps
each allowed name to a function or class of this module, which only builds arrays and dictionaries;
any other name aborts the reading. Nothing is imported, and no foreign code runs.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, Self, cast

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from worldpose.parsing import read_npy, read_npy_header

FILE_BYTES: Final = 8 << 30
"""Maximum unpacked size of a file [byte]: whole results without surfaces are a hundredth."""
MAX_ELEMENTS: Final = 1 << 28
"""Maximum elements of a tensor or dense matrix: three times SMPL's pose directions with 300
shapes."""

_NUMBER_TYPES: Final = re.compile(r"b1|[iu][1248]|f[248]|[US]\d{1,5}")
_TORCH_TYPES: Final[Mapping[str, str]] = {
    **{"Double": "f8", "Float": "f4", "Half": "f2", "Bool": "b1"},
    **{"Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1", "Byte": "u1"},
}


class _Built:
    """An object to which a pickle gives a state after its creation; `value` is what it stands for.

    The value is None for objects without a plain equivalent. A bad state raises any exception.
    """

    value: Any = None

    # Pickles create objects both by calling the class and by __new__ alone.
    def __new__(cls, *args: Any, **_: object) -> Self:  # noqa: ANN401
        built = super().__new__(cls)
        built.start(*args)
        return built

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def start(self, *args: Any) -> None:  # noqa: ANN401
        """Take the arguments of the class."""

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        pass


class _Table(dict[Any, Any]):
    """A dictionary of any class; other state of the class is dropped."""

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__()

    def __setstate__(self, state: object) -> None:
        pass


class _Dtype(_Built):
    """numpy's `dtype`; the value is its type code, with the byte order."""

    def start(self, *args: Any) -> None:  # noqa: ANN401
        self.value = args[0]

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        if state[1] in ("<", ">"):
            self.value = state[1] + self.value


class _Array(_Built):
    """numpy's `_reconstruct`: an array of numbers or text, or a list of objects."""

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        _, shape, dtype, fortran, raw = state
        if dtype.value != "O8":
            self.value = _as_array(raw, dtype, shape, "F" if fortran else "C")
        elif not isinstance(raw, list) or math.prod(shape) != len(raw) or len(shape) > 1:
            raise ValueError(f"objects of shape {shape}")
        else:
            self.value = raw if shape else raw[0]


class _JoblibArray(_Built):
    """joblib's `NumpyArrayWrapper`: the bytes of the array follow in the file."""

    stream: ClassVar[io.BytesIO]

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        if state["dtype"].value == "O8":
            self.value = _Unpickler(self.stream).load()
            return
        if state.get("numpy_array_alignment_bytes") is not None:
            self.stream.read(self.stream.read(1)[0])
        count = _number_type(state["dtype"]).itemsize * math.prod(map(int, state["shape"]))
        raw = self.stream.read(max(count, 0))
        self.value = _as_array(raw, state["dtype"], state["shape"], state["order"])


class _Sparse(_Built):
    """scipy's sparse matrix; the value is dense."""

    form: ClassVar[Any]

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        parts = tuple(_number_array(state[name]) for name in ("data", "indices", "indptr"))
        shape = tuple(int(length) for length in state["_shape"])
        if math.prod(shape) > MAX_ELEMENTS:
            raise ValueError(f"a sparse matrix of shape {shape}")
        matrix = self.form(parts, shape=shape)
        # scipy's own code writes wherever the indices point; its check leaves out the rows of a
        # matrix whose last row ends at 0.
        matrix.check_format(full_check=True)
        if (np.diff(matrix.indptr) < 0).any():
            raise ValueError("a sparse matrix with rows that end before they begin")
        self.value = matrix.toarray()


class _Chumpy(_Built):
    """An object of chumpy: it wraps an array (`x`), or selects from another one (`a`, `idxs`)."""

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        self.value = state.get("x")
        if "a" in state and "idxs" in state:
            selected = _number_array(state["a"]).ravel()[_number_array(state["idxs"])]
            shape = state.get("preferred_shape")
            self.value = selected if shape is None else selected.reshape([int(n) for n in shape])


def _reconstruct(kind: object = None, *_: object) -> _Built:
    """`copyreg._reconstructor`: create an object of a class of this module."""
    if not (isinstance(kind, type) and issubclass(kind, _Built)):
        raise pickle.UnpicklingError("an object of an unknown class")
    return kind()


def _encode(text: str = "", encoding: str = "latin1") -> bytes:
    """`_codecs.encode`, Python 3's encoding of bytes for Python 2; empty ones are `bytes()`."""
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"bytes written as {encoding}")
    return text.encode("latin1")


def _ignore(*_: object) -> None:
    """Stand for a class without a plain equivalent."""


def _load_legacy_storage(content: bytes) -> NDArray[Any]:
    """Torch's `_load_from_bytes`: a file in the older format, of five pickles and one storage."""
    stream = io.BytesIO(content)
    found: list[tuple[str, int]] = []

    def note_type(identity: object) -> object:
        code, key, count = _parse_storage_id(identity)
        found.append((code, count))
        return key

    for _ in range(5):
        _Unpickler(stream, note_type).load()
    ((code, count),) = set(found)
    kind = np.dtype(f"<{code}")
    if struct.unpack("<q", stream.read(8)) != (count,):
        raise ValueError("a storage of another length")
    return np.frombuffer(stream.read(count * kind.itemsize), kind, count)


def _view_tensor(storage: object, first: int, lengths: Any, steps: Any, *_: object) -> NDArray[Any]:  # noqa: ANN401
    """Torch's `_rebuild_tensor_v2`: a copy of the elements of a storage that a tensor views."""
    if not isinstance(storage, np.ndarray):
        raise ValueError("a tensor without numbers")
    if len(lengths) != len(steps) or min((first, *lengths, *steps)) < 0:
        raise ValueError(f"a tensor of lengths {list(lengths)} and steps {list(steps)}")
    last = first + sum((n - 1) * step for n, step in zip(lengths, steps, strict=True))
    if 0 not in lengths and (last >= storage.size or math.prod(lengths) > MAX_ELEMENTS):
        raise ValueError(f"a tensor of lengths {list(lengths)} on {storage.size} numbers")
    strides = [step * storage.itemsize for step in steps]
    part = storage[first:] if 0 not in lengths else storage[:0]
    return np.lib.stride_tricks.as_strided(part, list(lengths), strides).copy()


ALLOWED: Final[Mapping[tuple[str, str], Any]] = {
    ("numpy", "ndarray"): _ignore,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): _Table,
    ("collections", "defaultdict"): _Table,
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _JoblibArray,
    ("torch._utils", "_rebuild_tensor_v2"): _view_tensor,
    ("torch._utils", "_rebuild_parameter"): lambda data, *_: _number_array(data),
    ("torch.storage", "_load_from_bytes"): _load_legacy_storage,
    **{(module, "_reconstructor"): _reconstruct for module in ("copyreg", "copy_reg")},
    **{
        (module, name): stand_in
        for module in ("builtins", "__builtin__")
        for name, stand_in in (
            *(("dict", _Table), ("bytes", _encode)),
            *((name, _ignore) for name in ("object", "list", "int", "float", "set")),
        )
    },
    **{
        (f"numpy.{core}.{module}", name): stand_in
        for core in ("core", "_core")
        for module, name, stand_in in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", lambda kind, raw: _as_array(raw, kind, (), "C").item()),
            ("numeric", "_frombuffer", lambda raw, *form: _as_array(raw, *form)),
        )
    },
    **{
        (f"scipy.sparse.{module}", f"{form}_matrix"): type("_Sparse", (_Sparse,), {"form": kind})
        for form, kind in (("csc", scipy.sparse.csc_array), ("csr", scipy.sparse.csr_array))
        for module in (form, f"_{form}")
    },
    # A text cannot be called; it tells the type of a torch storage.
    **{("torch", f"{name}Storage"): code for name, code in _TORCH_TYPES.items()},
}
"""Names that a file may use, and what stands for each; also all names of chumpy."""


def _refuse_storage(_: object) -> object:
    raise pickle.UnpicklingError("an object kept outside the file")


class _Unpickler(pickle._Unpickler):
    """Reads one pickle; a name that is not allowed raises an error.

    It extends the Python implementation, not the C one: that one allocates memory for as many
    memoized objects as a file of a few bytes claims.
    """

    def __init__(
        self, stream: io.BytesIO, load_storage: Callable[[object], object] = _refuse_storage
    ) -> None:
        # Python 2 wrote the bytes of arrays as text.
        super().__init__(stream, encoding="latin1")
        self._joblib = type("_JoblibArray", (_JoblibArray,), {"stream": stream})
        self._load_storage = load_storage

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if module == "chumpy" or module.startswith("chumpy."):
            return _Chumpy
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"the name {module}.{name}, which is not allowed")
        found = ALLOWED[module, name]
        return self._joblib if found is _JoblibArray else found

    def persistent_load(self, pid: Any) -> Any:  # noqa: ANN401
        return self._load_storage(pid)

    def load_build(self) -> None:
        """Pass a state only to this module's objects; on others it would set attributes."""
        if not isinstance(cast("list[object]", self.stack)[-2], _Built | _Table):  # type: ignore[attr-defined]
            raise pickle.UnpicklingError("a state for an object that has none")
        pickle._Unpickler.load_build(self)  # type: ignore[attr-defined]

    def load_bytearray8(self) -> None:
        """Read existing bytes; Python's own version allocates as many as the file claims."""
        (length,) = struct.unpack("<Q", self.read(8))  # type: ignore[attr-defined]
        content = self.read(length) if length < 1 << 62 else b""  # type: ignore[attr-defined]
        if len(content) != length:
            raise pickle.UnpicklingError(f"{len(content)} of {length} bytes")
        self.append(bytearray(content))  # type: ignore[attr-defined]

    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,
        pickle.BUILD[0]: load_build,
        pickle.BYTEARRAY8[0]: load_bytearray8,
    }


def read_pickle(path: Path) -> Any:  # noqa: ANN401
    """Return the content of a file: dictionaries, lists, numbers, text, bytes and arrays.

    Pickles, also gzipped or of joblib (plain or zlib), numpy's `.npy` and torch's `.pt` are
    recognised by their bytes. A tuple becomes a list, and an object of another kind None. OSError
    if the file cannot be read; ValueError if it is damaged, too large, contains itself, or names a
    class that is not allowed.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as file:
                return _plain(_load_torch_archive(file), {})
        return _plain(_load_stream(_decompress(path)), {})
    except (OSError, MemoryError):
        raise
    # A damaged or hostile pickle can fail in any way: pickle documents no complete list.
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error


_OPEN: Final = object()
"""Stands for an object whose parts are being converted."""


def _plain(value: Any, done: dict[int, tuple[Any, Any]]) -> Any:  # noqa: ANN401
    """Return a value without objects of this module.

    `done` are the converted objects and their conversions, by identity: nested sharing would
    otherwise grow without bound.
    """
    if isinstance(value, bool | int | float | str | bytes | np.ndarray):
        return value
    if id(value) in done:
        if done[id(value)][1] is _OPEN:
            raise ValueError("an object that contains itself")
        return done[id(value)][1]
    done[id(value)] = value, _OPEN
    found: Any = None
    if isinstance(value, _Built):
        found = _plain(value.value, done)
    elif isinstance(value, dict):
        keys = (tuple(key) if isinstance(key, list) else key for key in _plain([*value], done))
        found = dict(zip(keys, _plain([*value.values()], done), strict=True))
    elif isinstance(value, list | tuple):
        found = [_plain(each, done) for each in value]
    done[id(value)] = value, found
    return found


def _number_type(note: object) -> np.dtype[Any]:
    """Return the numpy type of a note, for numbers and text only."""
    if not isinstance(note, _Dtype) or not isinstance(note.value, str):
        raise ValueError("an array without a type")
    if not _NUMBER_TYPES.fullmatch(note.value.lstrip("<>")):
        raise ValueError(f"elements of type {note.value!r}")
    return np.dtype(note.value)


def _as_array(raw: object, note: object, shape: Any, order: str) -> NDArray[Any]:  # noqa: ANN401
    """Return bytes as an array; their number must match the shape."""
    kind = _number_type(note)
    content = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(content, bytes | bytearray):
        raise ValueError(f"a {type(raw).__name__} in place of bytes")
    lengths = [int(length) for length in shape]
    if math.prod(lengths) * kind.itemsize != len(content) or any(n < 0 for n in lengths):
        raise ValueError(f"{len(content)} bytes for the shape {tuple(lengths)}")
    flat: NDArray[Any] = np.frombuffer(content, kind)
    return flat.reshape(lengths, order="F" if order == "F" else "C")


def _number_array(value: object) -> NDArray[Any]:
    value = _plain(value, {})
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise ValueError(f"a {type(value).__name__} without numbers")
    return value


def _decompress(path: Path) -> io.BytesIO:
    """Return the bytes of a file, decompressed if necessary."""
    if path.stat().st_size > FILE_BYTES:
        raise ValueError(f"{path.stat().st_size} bytes, more than {FILE_BYTES}")
    content = path.read_bytes()
    # zlib's streams, of joblib, begin with 0x78, gzip's with 0x1f 0x8b; no pickle does.
    if content[:1] == b"\x78" or content[:2] == b"\x1f\x8b":
        unpacker = zlib.decompressobj(wbits=32 + zlib.MAX_WBITS)
        content = unpacker.decompress(content, FILE_BYTES)
        if not unpacker.eof:
            raise ValueError("a compressed file that does not end, or is too large")
    return io.BytesIO(content)


def _load_stream(stream: io.BytesIO) -> object:
    if not stream.getvalue().startswith(b"\x93NUMPY"):
        return _Unpickler(stream).load()
    if read_npy_header(stream)[2].hasobject:
        return _Unpickler(stream).load()
    stream.seek(0)
    return read_npy(stream)


def _load_torch_archive(file: zipfile.ZipFile) -> object:
    names = [name for name in file.namelist() if name.endswith("/data.pkl")]
    if len(names) != 1:
        raise ValueError("a zip file that torch did not write")
    if sum(info.file_size for info in file.infolist()) > FILE_BYTES:
        raise ValueError(f"more than {FILE_BYTES} unpacked bytes")
    root = names[0].removesuffix("data.pkl")
    if f"{root}byteorder" in file.namelist() and file.read(f"{root}byteorder") != b"little":
        raise ValueError("another byte order than little")

    def load_storage(identity: object) -> object:
        code, key, _ = _parse_storage_id(identity)
        return np.frombuffer(file.read(f"{root}data/{key}"), np.dtype(f"<{code}"))

    return _Unpickler(io.BytesIO(file.read(names[0])), load_storage).load()


def _parse_storage_id(identity: object) -> tuple[str, str, int]:
    """Return type, key and length of a torch storage from its persistent id."""
    if not isinstance(identity, tuple) or len(identity) < 5 or identity[0] != "storage":
        raise pickle.UnpicklingError("an object kept outside the file")
    code, key, _, count = identity[1:5]
    if code not in _TORCH_TYPES.values():
        raise pickle.UnpicklingError("a storage of an unknown type")
    return code, str(key), int(count)
