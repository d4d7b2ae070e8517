"""Checked access to parts of a method's file."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.errors import InputError
from worldpose.pickles import FILE_BYTES, plain, read_notes


def format_error(where: object, expected: str, found: str) -> InputError:
    """Return the error about one place of a method's file."""
    return InputError(
        str(where),
        expected=expected,
        found=found,
        todo="Give the file that the method's own code wrote, or name another method.",
    )


def read_pickled(path: Path) -> Any:  # noqa: ANN401
    """Return the content of a file: dictionaries, lists, numbers, text and arrays.

    `worldpose.pickles` reads pickles, also of joblib, numpy and torch, and runs nothing in them.

    Raises:
        InputError: the file is not readable, or names classes that no result needs.
    """
    try:
        found = plain(read_notes(path))
        if not isinstance(found, dict | list | np.ndarray):
            raise ValueError(f"a {type(found).__name__}")
        return found
    except OSError as error:
        raise _reading_error(path, f"a file that cannot be read ({error})") from None
    except ValueError as error:
        raise _reading_error(path, f"a file that cannot be read as such ({error})") from error


def _reading_error(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="results of a method: arrays in a pickle, joblib, numpy or torch file",
        found=found,
        todo="Give the file that the method's own code wrote. Nothing in this file was run.",
    )


def get_part(where: str, content: object, *keys: object) -> Any:  # noqa: ANN401
    """Return the value at a path of keys in nested dictionaries.

    Raises:
        InputError: a key is missing; the error names the first missing key.
    """
    for key in keys:
        if not isinstance(content, Mapping) or key not in content:
            known = ", ".join(map(str, list(content)[:8])) if isinstance(content, Mapping) else ""
            raise format_error(where, f"{key}", known or f"a {type(content).__name__}")
        content = content[key]
        where = f"{where}: {key}"
    return content


def as_floats(where: str, value: object) -> Floats:
    """Return numbers as an array of any shape.

    Raises:
        InputError: the values are not numbers.
    """
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise format_error(where, "numbers", f"a {type(value).__name__}") from None


def floats(where: str, value: object, shape: tuple[int | None, ...]) -> Floats:
    """Return numbers of a shape, None for any length; extra dimensions of length one are dropped.

    Raises:
        InputError: not numbers, or another shape.
    """
    array = as_floats(where, value)
    while array.ndim > len(shape) and 1 in array.shape:
        # The first extra dimension that the shape lacks.
        lone = next(
            (
                i
                for i, n in enumerate(array.shape)
                if n == 1 and _fits(np.delete(array.shape, i), shape)
            ),
            array.shape.index(1),
        )
        array = array.squeeze(lone)
    if not _fits(array.shape, shape):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise format_error(where, f"numbers of shape ({wanted})", f"{array.shape}")
    return array


def integers(where: str, value: object, count: int | None = None) -> NDArray[np.int64]:
    """Return integers (count,), such as frames.

    Raises:
        InputError: not integers, or another number of them.
    """
    array = floats(where, value, (count,))
    if not np.array_equal(array, np.round(array)):
        raise format_error(where, "whole numbers", f"{array[:4]}")
    return array.astype(np.int64)


def integer(where: str, value: object) -> int:
    """Return one integer, also if written as text.

    Raises:
        InputError: the value is not an integer.
    """
    found = floats(where, value, ())
    if not np.isfinite(found) or found != np.round(found) or abs(found) > 2**53:
        raise format_error(where, "a whole number", f"{value}")
    return int(found)


def require_ascending(where: str, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return frames after checking that they ascend.

    Raises:
        InputError: the frames do not ascend, or are negative.
    """
    if np.any(np.diff(frames) <= 0) or np.any(frames < 0):
        raise format_error(where, "frames that rise from 0", f"{frames[:8]}")
    return frames


def read_arrays(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return some arrays of an npz file; others are ignored, pickled ones refused.

    Raises:
        InputError: the file is not an npz file, is too large, or lacks an array.
    """
    try:
        with zipfile.ZipFile(path) as file:
            size = sum(file.getinfo(f"{name}.npy").file_size for name in names)
        if size > FILE_BYTES:
            raise format_error(path, f"at most {FILE_BYTES} bytes of arrays", f"{size}")
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names}
    except KeyError as error:
        raise format_error(path, f"the arrays {', '.join(names)}", str(error.args[0])) from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise format_error(path, "a whole npz file", str(error)) from None


def _fits(found: object, shape: tuple[int | None, ...]) -> bool:
    lengths = tuple(np.asarray(found).tolist())
    return len(lengths) == len(shape) and all(
        wanted in (None, n) for n, wanted in zip(lengths, shape, strict=True)
    )
