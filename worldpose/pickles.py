"""Safe reading of untrusted files of pickle, joblib, numpy and torch, without executing them.

A pickle is a program whose instructions call any function that the file names. Here `ALLOWED` maps
each allowed name to a class that only records its arguments, and any other name aborts the reading:
nothing is imported, no foreign code runs. `read_notes` returns the content with these records, the
notes. `plain` checks the notes and converts them to arrays, lists and dictionaries.
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
MAX_ELEMENTS: Final = 1 << 30
"""Maximum elements of a tensor: 1 GB of bytes; no array holds an hour of 25 surfaces."""
MAX_DENSE_ELEMENTS: Final = 1 << 28
"""Maximum elements of a sparse matrix: three times SMPL's pose directions with 300 shapes."""

_NUMPY: Final = b"\x93NUMPY"
_NUMBER_TYPES: Final = re.compile(r"b1|[iu][1248]|f[248]|[US]\d{1,5}")
_TORCH_TYPES: Final[Mapping[str, str]] = {
    **{"Double": "f8", "Float": "f4", "Half": "f2", "Bool": "b1"},
    **{"Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1", "Byte": "u1"},
}
_TORCH_MAGIC: Final = 0x1950A86A20F9469CFC6C
"""First pickle of torch's older files."""


_Convert = Callable[[object], Any]
"""Converts an object that may hold notes to plain content."""


class _Note:
    """Records the arguments and the state that a pickle passes to a class."""

    args: tuple[Any, ...]
    state: Any

    # Pickles create objects both by calling the class and by __new__ alone.
    def __new__(cls, *args: object, **_: object) -> Self:
        note = super().__new__(cls)
        note.args, note.state = args, None
        return note

    def __init__(self, *_: object, **__: object) -> None:
        pass

    # Without it, the unpickler would set attributes that the file chooses.
    def __setstate__(self, state: object) -> None:
        self.state = state

    def decode(self, convert: _Convert) -> object:
        """Return the content, None without a plain equivalent; a bad state raises any exception."""
        return None


class _Table(dict[Any, Any]):
    """A dictionary of any class; other state of the class is dropped."""

    def __new__(cls, *_: object, **__: object) -> Self:
        return super().__new__(cls)

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__()

    def __setstate__(self, state: object) -> None:
        pass


class _Kind(_Note):
    """A class that is only named, such as the type of an array."""


class _Reconstructor(_Note):
    """`copyreg._reconstructor`: creates an object of the given class, here always a note."""

    def __new__(cls, kind: object = None, *_: object) -> _Note:  # type: ignore[misc]
        if not (isinstance(kind, type) and issubclass(kind, _Note)):
            raise pickle.UnpicklingError("an object of an unknown class")
        return _Note.__new__(kind)


class _Dtype(_Note):
    """numpy's `dtype`."""

    @property
    def of_objects(self) -> bool:
        """Whether the elements are Python objects."""
        return bool(self.args[0] == "O8")


class _Encoded(_Note):
    """`_codecs.encode`, Python 3's encoding of bytes for Python 2; empty ones are plain `bytes`."""

    def decode(self, convert: _Convert) -> object:
        return _as_array(self, np.dtype("u1"), (len((self.args or ("",))[0]),), "C")


class _Scalar(_Note):
    """numpy's `scalar`: a type and its bytes."""

    def decode(self, convert: _Convert) -> object:
        dtype, raw = self.args
        return _as_array(raw, _number_type(dtype), (1,), "C")[0].item()


class _Array(_Note):
    """numpy's `_reconstruct`: the content comes as the state."""

    def decode(self, convert: _Convert) -> object:
        _, shape, dtype, fortran, raw = self.state
        if isinstance(dtype, _Dtype) and dtype.of_objects:
            if not isinstance(raw, list) or math.prod(shape) != len(raw) or len(shape) > 1:
                raise ValueError(f"objects of shape {shape}")
            return raw if shape else {"item": raw[0]}
        return _as_array(raw, _number_type(dtype), shape, "F" if fortran else "C")


class _Buffer(_Note):
    """numpy's `_frombuffer`, used by protocol 5."""

    def decode(self, convert: _Convert) -> object:
        raw, dtype, shape, order = self.args
        return _as_array(raw, _number_type(dtype), shape, order)


class _JoblibArray(_Note):
    """joblib's `NumpyArrayWrapper`: the bytes of the array follow in the file."""

    array: object = None

    def read(self, stream: io.BytesIO) -> None:
        """Read the array from the current position of the stream."""
        state = self.state
        if isinstance(state["dtype"], _Dtype) and state["dtype"].of_objects:
            self.array = _Unpickler(stream).load()
            return
        if state.get("numpy_array_alignment_bytes") is not None:
            stream.read(stream.read(1)[0])
        kind = _number_type(state["dtype"])
        count = kind.itemsize
        for length in state["shape"]:
            count *= int(length)
        raw = stream.read(count) if count >= 0 else b""
        self.array = _as_array(raw, kind, state["shape"], state["order"])

    def decode(self, convert: _Convert) -> object:
        if self.array is None or isinstance(self.array, _Kind):
            raise ValueError("an array without bytes")
        return self.array


class _Sparse(_Note):
    """scipy's sparse matrix with compressed columns; it becomes dense."""

    form: ClassVar[Any] = scipy.sparse.csc_array

    def decode(self, convert: _Convert) -> object:
        parts = [_number_array(convert(self.state[name])) for name in ("data", "indices", "indptr")]
        shape = tuple(int(length) for length in self.state["_shape"])
        if math.prod(shape) > MAX_DENSE_ELEMENTS:
            raise ValueError(f"a sparse matrix of shape {shape}")
        matrix = self.form(tuple(parts), shape=shape)
        # scipy's own code writes wherever the indices point.
        matrix.check_format(full_check=True)
        return matrix.toarray()


class _SparseRows(_Sparse):
    """scipy's sparse matrix with compressed rows."""

    form = scipy.sparse.csr_array


class _Chumpy(_Note):
    """An object of chumpy: it wraps an array (`x`), or selects from another one (`a`, `idxs`)."""

    def decode(self, convert: _Convert) -> object:
        if "x" in self.state:
            return _number_array(convert(self.state["x"]))
        selected = _number_array(convert(self.state["a"])).ravel()[
            _number_array(convert(self.state["idxs"]))
        ]
        shape = self.state.get("preferred_shape")
        return selected if shape is None else selected.reshape([int(length) for length in shape])


class _Tensor(_Note):
    """torch's `_rebuild_tensor_v2`: a storage, and the offset, lengths and strides of a view."""

    def decode(self, convert: _Convert) -> object:
        storage, first, lengths, steps = self.args[:4]
        if isinstance(storage, _LegacyStorage):
            storage = storage.read()
        if not isinstance(storage, np.ndarray):
            raise ValueError("a tensor without numbers")
        return _copy_view(storage, int(first), list(lengths), list(steps))


class _Parameter(_Note):
    """torch's `_rebuild_parameter`: a tensor and whether it is trained."""

    def decode(self, convert: _Convert) -> object:
        if not isinstance(self.args[0], _Tensor):
            raise ValueError("a parameter without a tensor")
        return self.args[0].decode(convert)


class _StorageType(_Note):
    """A class of torch's storages; each subclass has its numpy type in `code`."""

    code: ClassVar[str]


class _LegacyStorage(_Note):
    """torch's `_load_from_bytes`: a file in the older format within a pickle, with one storage."""

    def read(self) -> NDArray[Any]:
        """Return the storage (elements,): the file has five pickles, then the bytes."""
        stream = io.BytesIO(self.args[0])
        types: dict[str, tuple[str, int]] = {}

        def note_type(identity: object) -> object:
            code, key, count = _parse_storage_id(identity)
            types[key] = (code, count)
            return key

        magic, _, _, _, keys = (_Unpickler(stream, note_type).load() for _ in range(5))
        if magic != _TORCH_MAGIC:
            raise ValueError("a storage in an unknown form")
        if len(types) != 1 or list(keys) != list(types):
            raise ValueError("several storages in one")
        code, count = types[keys[0]]
        stated = struct.unpack("<q", stream.read(8))[0]
        flat = _parse_storage(code, stream.read(count * np.dtype(code).itemsize))
        if stated != count or len(flat) != count:
            raise ValueError(f"{len(flat)} of {count} numbers")
        return flat


ALLOWED: Final[Mapping[tuple[str, str], type[Any]]] = {
    ("numpy", "ndarray"): _Kind,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Encoded,
    ("collections", "OrderedDict"): _Table,
    ("collections", "defaultdict"): _Table,
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _JoblibArray,
    ("torch._utils", "_rebuild_tensor_v2"): _Tensor,
    ("torch._utils", "_rebuild_parameter"): _Parameter,
    ("torch.storage", "_load_from_bytes"): _LegacyStorage,
    **{(module, "_reconstructor"): _Reconstructor for module in ("copyreg", "copy_reg")},
    **{
        (module, name): kind
        for module in ("builtins", "__builtin__")
        for name, kind in (
            *(("dict", _Table), ("bytes", _Encoded)),
            *((name, _Kind) for name in ("object", "list", "int", "float", "set")),
        )
    },
    **{
        (f"numpy.{core}.{module}", name): note
        for core in ("core", "_core")
        for module, name, note in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _Scalar),
            ("numeric", "_frombuffer", _Buffer),
        )
    },
    **{
        (f"scipy.sparse.{module}", f"{form}_matrix"): note
        for form, note in (("csc", _Sparse), ("csr", _SparseRows))
        for module in (form, f"_{form}")
    },
    **{
        ("torch", f"{name}Storage"): type(f"{name}Storage", (_StorageType,), {"code": code})
        for name, code in _TORCH_TYPES.items()
    },
}
"""Names that a file may use, and the class that replaces each; also all names of chumpy."""


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
        self._source, self._load_storage = stream, load_storage

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if module == "chumpy" or module.startswith("chumpy."):
            return _Chumpy
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"the name {module}.{name}, which is not allowed")
        return ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Any:  # noqa: ANN401
        return self._load_storage(pid)

    def load_build(self) -> None:
        """Pass a state only to notes; on other objects it would set attributes."""
        instance = cast("list[object]", self.stack)[-2]  # type: ignore[attr-defined]
        if not hasattr(instance, "__setstate__") or isinstance(instance, type):
            raise pickle.UnpicklingError("a state for an object that has none")
        pickle._Unpickler.load_build(self)  # type: ignore[attr-defined]
        if isinstance(instance, _JoblibArray):
            instance.read(self._source)

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


def read_notes(path: Path) -> Any:  # noqa: ANN401
    """Return the content of a file, with a note for each object that is not plain.

    Pickles, also gzipped or of joblib (plain or zlib), numpy's `.npy` and torch's `.pt` are
    recognised by their bytes.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is damaged, too large, or names a class that is not allowed.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as file:
                return _load_torch_archive(file)
        return _load_stream(_decompress(path))
    except (OSError, MemoryError):
        raise
    # A damaged or hostile pickle can fail in any way: pickle documents no complete list.
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error


def plain(value: object) -> Any:  # noqa: ANN401
    """Convert notes; return dictionaries, lists, numbers, text, bytes and arrays.

    Raises:
        ValueError: a malformed note, or an object that contains itself.
    """
    try:
        return _PlainConverter().convert(value)
    except MemoryError:
        raise
    except Exception as error:  # as in `read_notes`
        raise ValueError(str(error) or type(error).__name__) from error


def _number_type(note: object) -> np.dtype[Any]:
    """Return the numpy type of a note, for numbers and text only.

    Raises:
        ValueError: the note describes another type.
    """
    if not isinstance(note, _Dtype) or not note.args:
        raise ValueError("an array without a type")
    code = note.args[0]
    order = note.state[1] if note.state else "="
    if (
        not isinstance(code, str)
        or not _NUMBER_TYPES.fullmatch(code)
        or order not in ("<", ">", "|", "=")
    ):
        raise ValueError(f"elements of type {code!r}")
    return np.dtype(("" if order == "|" else order) + code)


def _as_array(raw: object, kind: np.dtype[Any], shape: object, order: str) -> NDArray[Any]:
    """Return bytes as an array; their number must match the shape.

    Raises:
        ValueError: not bytes, or another number of them.
    """
    if isinstance(raw, _Encoded):
        text, encoding = raw.args or ("", "latin1")
        if encoding not in ("latin1", "latin-1"):
            raise ValueError(f"bytes written as {encoding}")
        raw = text
    content = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(content, bytes | bytearray) or not isinstance(shape, tuple | list):
        raise ValueError(f"a {type(raw).__name__} in place of bytes")
    lengths = [int(length) for length in shape]
    if math.prod(lengths) * kind.itemsize != len(content) or any(n < 0 for n in lengths):
        raise ValueError(f"{len(content)} bytes for the shape {tuple(lengths)}")
    flat: NDArray[Any] = np.frombuffer(content, kind)
    return flat.reshape(lengths, order="F" if order == "F" else "C")


class _PlainConverter:
    def __init__(self) -> None:
        # Shared objects are converted once: nested sharing would otherwise grow without bound. The
        # original is kept so that its address is not reused for another object.
        self._done: dict[int, tuple[object, Any]] = {}
        self._open: set[int] = set()

    def convert(self, value: object) -> Any:  # noqa: ANN401
        if value is None or isinstance(value, bool | int | float | str | bytes):
            return value
        place = id(value)
        if place in self._done:
            return self._done[place][1]
        if place in self._open:
            raise ValueError("an object that contains itself")
        self._open.add(place)
        converted = self._convert_object(value)
        self._open.discard(place)
        self._done[place] = (value, converted)
        return converted

    def _convert_object(self, value: object) -> object:
        if isinstance(value, dict):
            return {_as_key(self.convert(key)): self.convert(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [self.convert(each) for each in value]
        if isinstance(value, _Note):
            found = value.decode(self.convert)
            return self.convert(found) if isinstance(found, dict | list | _Note) else found
        # State without a plain equivalent, such as a set, becomes None.
        return value if isinstance(value, np.ndarray) else None


def _as_key(value: object) -> object:
    """Convert lists, which tuples become, to valid keys."""
    return tuple(value) if isinstance(value, list) else value


def _number_array(value: object) -> NDArray[Any]:
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
    if stream.getvalue()[: len(_NUMPY)] != _NUMPY:
        return _Unpickler(stream).load()
    _, _, kind = read_npy_header(stream)
    if not kind.hasobject:
        stream.seek(0)
        return read_npy(stream)
    found = plain(_Unpickler(stream).load())
    # numpy stores any object as an array of objects without dimensions.
    return found["item"] if isinstance(found, dict) and set(found) == {"item"} else found


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
        return _parse_storage(code, file.read(f"{root}data/{key}"))

    return _Unpickler(io.BytesIO(file.read(names[0])), load_storage).load()


def _parse_storage_id(identity: object) -> tuple[str, str, int]:
    """Return type, key and length of a torch storage from its persistent id."""
    if not isinstance(identity, tuple) or len(identity) < 5 or identity[0] != "storage":
        raise pickle.UnpicklingError("an object kept outside the file")
    kind, key, _, count = identity[1:5]
    if not (isinstance(kind, type) and issubclass(kind, _StorageType)):
        raise pickle.UnpicklingError("a storage of an unknown type")
    return kind.code, str(key), int(count)


def _parse_storage(code: str, raw: bytes) -> NDArray[Any]:
    kind = np.dtype(f"<{code}")
    return np.frombuffer(raw[: len(raw) // kind.itemsize * kind.itemsize], kind)


def _copy_view(
    flat: NDArray[Any], first: int, lengths: list[int], steps: list[int]
) -> NDArray[Any]:
    """Return a copy of the elements of a storage that a tensor views."""
    if len(lengths) != len(steps) or first < 0 or any(n < 0 for n in (*lengths, *steps)):
        raise ValueError(f"a tensor of lengths {lengths} and steps {steps}")
    if 0 in lengths:
        return np.empty(lengths, flat.dtype)
    last = first + sum((n - 1) * step for n, step in zip(lengths, steps, strict=True))
    if last >= len(flat) or math.prod(lengths) > MAX_ELEMENTS:
        raise ValueError(f"a tensor of lengths {lengths} on {len(flat)} numbers")
    strides = [step * flat.itemsize for step in steps]
    view: NDArray[Any] = np.lib.stride_tricks.as_strided(flat[first:], lengths, strides)
    return view.copy()
