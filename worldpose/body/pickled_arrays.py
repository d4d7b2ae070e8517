"""Reader of numpy, scipy and chumpy arrays in the pickles of SMPL and related models.

Nothing that the pickle names is imported or run (`worldpose.pickles`): neither chumpy nor scipy's
own unpickling is involved.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from worldpose.body.body_file import unreadable
from worldpose.pickles import ALLOWED, Note, Unpickler, plain

_MALFORMED: Final = (
    *(ArithmeticError, AttributeError, LookupError, TypeError, ValueError),
    *(MemoryError, RecursionError),
)
_LARGEST: Final = 1 << 28
"""Maximum elements of a dense array: three times the pose directions with 300 shapes."""


class _Sparse(Note):
    """A sparse matrix with compressed columns."""


class _SparseRows(_Sparse):
    """A sparse matrix with compressed rows."""


class _Chumpy(Note):
    """An array inside an object of chumpy."""


_NAMES: Final[Mapping[tuple[str, str], type[Any]]] = {
    **ALLOWED,
    **{
        (f"scipy.sparse.{module}", f"{kind}_matrix"): note
        for kind, note in (("csc", _Sparse), ("csr", _SparseRows))
        for module in (kind, f"_{kind}")
    },
}


class _Unpickler(Unpickler):
    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if module == "chumpy" or module.startswith("chumpy."):
            return _Chumpy
        return super().find_class(module, name)


def read_pickled_arrays(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Return arrays of a pickled dictionary, dense even if the pickle holds sparse ones.

    Raises:
        InputError: the file cannot be read, names anything but arrays, or lacks a key.
    """
    try:
        content = _Unpickler(io.BytesIO(path.read_bytes()), _NAMES).load()
    except OSError as error:
        raise unreadable(path, f"what cannot be read ({error})") from None
    except MemoryError:
        raise
    # A damaged pickle can fail in any way: the documentation of pickle names no closed list.
    except Exception as error:
        raise unreadable(path, f"what cannot be read as a pickle ({_reason(error)})") from error
    if not isinstance(content, dict):
        raise unreadable(path, f"a pickled {type(content).__name__.strip('_').lower()}")
    lacking = [key for key in keys if key not in content]
    if lacking:
        raise unreadable(path, f"none named {', '.join(lacking)}")
    arrays = {}
    for key in keys:
        try:
            arrays[key] = _array(content[key])
        # The notes may hold content of any type.
        except _MALFORMED as bad:
            raise unreadable(path, f"{key} that is not an array ({_reason(bad)})") from None
    return arrays


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__


def _array(value: object) -> NDArray[np.generic]:
    found = plain(value, _DECODERS)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "biuf":
        raise ValueError(f"a {type(value).__name__.lower()} without numbers")
    return found


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
    """Return an array that chumpy wraps (`x`), or one indexed out of another (`a`, `idxs`)."""
    if "x" in note.state:
        return _array(note.state["x"])
    picked: NDArray[np.generic] = _array(note.state["a"]).ravel()[_array(note.state["idxs"])]
    shape = note.state.get("preferred_shape")
    return picked if shape is None else picked.reshape([int(length) for length in shape])


_DECODERS: Final[Mapping[type[Note], Callable[[Any], object]]] = {
    _Sparse: _sparse_array,
    _Chumpy: _chumpy_array,
}
