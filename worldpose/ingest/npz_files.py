"""Reader of untrusted npz files: checks every declared size before allocation."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from worldpose.errors import InputError

PACKED_RATIO: Final = 200
"""Maximum ratio of unpacked to packed bytes: poses with much padding for absent people reach 50."""

PACKED_BYTES: Final = 1 << 26
"""Unpacked bytes up to which any ratio is allowed."""

Header = tuple[tuple[int, ...], bool, np.dtype[np.generic]]
"""Shape, whether in Fortran order, type."""


def read_npz(path: Path, limit: int) -> dict[str, NDArray[np.generic]]:
    """Return all arrays of an npz file by name.

    Args:
        path: written by `numpy.savez` or `numpy.savez_compressed`.
        limit: maximum unpacked size of all arrays together [byte].

    Raises:
        InputError: with file and member: no npz, truncated, Python objects, inconsistent sizes, or
            too large.
    """
    with open_npz(path) as file:
        infos = [info for info in file.infolist() if info.filename.endswith(".npy")]
        for info in infos:
            read_header(path, file, info)
        require_size(path, infos, limit)
        return {info.filename.removesuffix(".npy"): read_array(path, file, info) for info in infos}


def open_npz(path: Path) -> zipfile.ZipFile:
    """Return the archive.

    Raises:
        InputError: the file is no archive.
    """
    try:
        return zipfile.ZipFile(path)
    # ValueError and NotImplementedError: a damaged directory, or one of a later version.
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise npz_error(str(path), "an npz file", _brief(error)) from error


def read_header(path: Path, file: zipfile.ZipFile, info: zipfile.ZipInfo) -> Header:
    """Return the header of a member, checked against its size.

    Raises:
        InputError: the member is no npy array of plain values, or its size contradicts its header.
    """
    where = f"{path}: {info.filename}"
    try:
        with file.open(info) as member:
            shape, fortran, dtype = _declared(member)
            start = member.tell()
    except Exception as error:  # a hostile header can raise nearly anything in numpy and zipfile
        raise npz_error(where, "an npy array", _brief(error)) from error
    if dtype.hasobject:
        raise npz_error(where, "numbers", "Python objects, which are never loaded")
    size = start + math.prod(shape) * dtype.itemsize
    if size != info.file_size or min(shape, default=0) < 0:
        raise npz_error(where, f"{size} bytes for its shape {shape}", f"{info.file_size} bytes")
    return shape, fortran, dtype


def require_size(path: Path, infos: list[zipfile.ZipInfo], limit: int) -> None:
    """Raise InputError for arrays beyond `limit` bytes, and for excessive compression ratios.

    Raises:
        InputError: with the file.
    """
    total = sum(info.file_size for info in infos)
    # The archive's directory may state more bytes than the file has.
    packed = min(sum(info.compress_size for info in infos), path.stat().st_size)
    expected = None
    if total > limit:
        expected = f"at most {limit} bytes of arrays"
    elif total > max(PACKED_BYTES, packed * PACKED_RATIO):
        expected = f"arrays packed at most {PACKED_RATIO} to 1"
    if expected is not None:
        raise InputError(
            str(path),
            expected=expected,
            found=f"{total} bytes of arrays in {packed}",
            todo="Give dimensions no more room than their entries need, or save the arrays "
            "without compression.",
        )


def read_array(path: Path, file: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[np.generic]:
    """Return a member's array; check its header and size first.

    Raises:
        InputError: the bytes are damaged.
    """
    try:
        with file.open(info) as member:
            array: NDArray[np.generic] = npy.read_array(member, allow_pickle=False)
            return np.ascontiguousarray(array)
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes can raise nearly anything, as in read_header
        raise npz_error(f"{path}: {info.filename}", "a whole array", _brief(error)) from error


def npz_error(where: str, expected: str, found: str) -> InputError:
    """Return the error about a place of an npz file."""
    return InputError(where, expected=expected, found=found, todo="Write or export it again.")


def _declared(member: IO[bytes]) -> Header:
    if npy.read_magic(member) != (1, 0):
        raise ValueError("another version than npy 1.0")  # later ones allow headers of 4 GB
    return npy.read_array_header_1_0(member)


def _brief(error: Exception) -> str:
    text = str(error) or type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."
