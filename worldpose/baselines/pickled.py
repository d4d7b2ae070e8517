"""Files written with pickle, joblib, numpy or torch, read without executing them."""

from __future__ import annotations

import io
import pickle
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
from numpy.lib import format as npy

from worldpose.baselines import tensors
from worldpose.errors import InputError
from worldpose.pickles import (
    ALLOWED,
    Dtype,
    Kind,
    Note,
    Unpickler,
    no_storage,
    numbers,
    plain,
    type_of,
)

FILE_BYTES: Final = 8 << 30
"""Maximum unpacked size of a file [byte]: whole results without surfaces are a hundredth."""

_NUMPY: Final = b"\x93NUMPY"


class Wrapped(Note):
    """joblib's note that an array's bytes follow in the file."""

    array: object = None


_NAMES: Final[Mapping[tuple[str, str], type[Any]]] = {
    **ALLOWED,
    **tensors.ALLOWED,
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): Wrapped,
}
_DECODERS: Final[Mapping[type[Note], Callable[[Any], object]]] = {
    **tensors.decoders(lambda stream, storage: _Unpickler(stream, storage).load()),
    Wrapped: lambda note: note.array if isinstance(note.array, Note) else _whole(note),
}


def read_pickled(path: Path) -> Any:  # noqa: ANN401
    """Return the content of a file: dictionaries, lists, numbers, text and arrays.

    Pickles, also gzipped or of joblib (plain or zlib), numpy's `.npy` of objects and torch's `.pt`
    are recognised by their bytes.

    Raises:
        InputError: the file is not readable, or names classes that no result needs.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as file:
                stream, storage = tensors.open_archive(file, FILE_BYTES)
                found = plain(_Unpickler(stream, storage).load(), _DECODERS)
        else:
            found = plain(_content(_unpacked(path)), _DECODERS)
        if not isinstance(found, dict | list | np.ndarray):
            raise ValueError(f"a {type(found).__name__}")
        return found
    except OSError as error:
        raise _refused(path, f"what cannot be read ({error})") from None
    except MemoryError:
        raise
    # A damaged or hostile pickle can fail in any way: pickle documents no complete list.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise _refused(path, f"what cannot be read as such ({reason})") from error


def _refused(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="results of a method: arrays in a pickle, joblib, numpy or torch file",
        found=found,
        todo="Take the file that the method's own code wrote; nothing in it was run.",
    )


def _unpacked(path: Path) -> io.BytesIO:
    """Return the bytes of a file, decompressed if necessary."""
    if path.stat().st_size > FILE_BYTES:
        raise ValueError(f"{path.stat().st_size} bytes")
    content = path.read_bytes()
    # zlib's streams, of joblib, begin with 0x78, gzip's with 0x1f 0x8b; no pickle does.
    if content[:1] == b"\x78" or content[:2] == b"\x1f\x8b":
        unpacker = zlib.decompressobj(wbits=32 + zlib.MAX_WBITS)
        content = unpacker.decompress(content, FILE_BYTES)
        if not unpacker.eof:
            raise ValueError("a compressed file that does not end, or is too large")
    return io.BytesIO(content)


def _content(stream: io.BytesIO) -> object:
    if stream.getvalue()[: len(_NUMPY)] == _NUMPY:
        if npy.read_magic(stream) != (1, 0):
            raise ValueError("another version than npy 1.0")
        _, _, kind = npy.read_array_header_1_0(stream)
        if kind.hasobject:
            return _item(_Unpickler(stream).load())
        stream.seek(0)
        return npy.read_array(stream, allow_pickle=False)
    return _Unpickler(stream).load()


def _item(value: object) -> object:
    """Return the element of a zero-dimensional object array."""
    found = plain(value, _DECODERS)
    return found["item"] if isinstance(found, dict) and set(found) == {"item"} else found


class _Unpickler(Unpickler):
    """Unpickler for joblib's arrays, whose bytes follow their note."""

    def __init__(
        self, stream: io.BytesIO, storage: Callable[[object], object] = no_storage
    ) -> None:
        super().__init__(stream, _NAMES, storage)
        self._source = stream

    def load_build(self) -> None:
        instance = cast("list[object]", self.stack)[-2]  # type: ignore[attr-defined]
        super().load_build()
        if isinstance(instance, Wrapped):
            _read_wrapped(instance, self._source)

    dispatch: ClassVar[dict[int, Any]] = {**Unpickler.dispatch, pickle.BUILD[0]: load_build}


def _read_wrapped(note: Wrapped, source: io.BytesIO) -> None:
    """Read the array whose bytes follow at this position of joblib's file."""
    state = note.state
    if isinstance(state["dtype"], Dtype) and state["dtype"].args[0] == "O8":
        note.array = _Unpickler(source).load()
        return
    if state.get("numpy_array_alignment_bytes") is not None:
        source.read(source.read(1)[0])
    kind = type_of(state["dtype"])
    count = kind.itemsize
    for length in state["shape"]:
        count *= int(length)
    raw = source.read(count) if count >= 0 else b""
    note.array = numbers(raw, kind, state["shape"], state["order"])


def _whole(note: Wrapped) -> object:
    if note.array is None or isinstance(note.array, Kind):
        raise ValueError("an array without bytes")
    return note.array
