"""npz archives: deterministic writing, and reading that checks every declared size."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.formats.files import whole_file
from worldpose.parsing import Header, read_npy, read_npy_header

ARRAY_BYTES: Final = 16 << 30
"""Maximum size of one file's arrays [byte]: two hours of 25 people with covariance at 50
frames/s are 13 GB."""

_KINDS: Final = {"float": "f", "int": "iu", "text": "U"}
_MEANINGS: Final = {"float": "float numbers", "int": "int numbers", "text": "text"}
_READ_AS: Final[Mapping[str, type]] = {"float": np.float64, "int": np.int64, "text": np.str_}


@dataclass(frozen=True)
class Member:
    """Expected form of one array of an archive."""

    dims: tuple[str | int, ...]
    """Lengths, or names of lengths that must agree between members."""
    kind: Literal["float", "int", "text"]
    """Read as float64, int64 or str, whatever the width in the file."""
    required: bool = True


def write_archive(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as npz, whole or not at all; equal arrays give equal bytes."""
    with whole_file(path) as draft, zipfile.ZipFile(draft, "w") as file:
        for name, array in arrays.items():
            little = np.asarray(array, array.dtype.newbyteorder("<"), order="C")
            # A ZipInfo created by name alone has the fixed date 1980-01-01.
            with file.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                npy.write_array(member, little, version=(1, 0), allow_pickle=False)


def read_archive(
    path: Path, members: Mapping[str, Member], only: Collection[str] | None = None
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an npz file after validating their types, shapes and sizes.

    Args:
        path: the file.
        members: expected content; no other member is allowed.
        only: requested members; None = all. The others are not loaded.

    Returns:
        float64, int64 and str arrays by name; optional members that are absent are left out.

    Raises:
        InputError: the file is absent, truncated, too large or no npz, or has members that are
            missing, unknown, or of another type or shape; the error names file and member.
    """
    if not path.is_file():
        raise wrong(str(path), "an npz file", "nothing", "Check the path.")
    try:
        with zipfile.ZipFile(path) as file:
            infos = _infos(path, file, members)
            _check_headers(path, file, infos, members)
            return {
                name: _array(path, file, info, members[name])
                for name, info in infos.items()
                if only is None or name in only
            }
    except (zipfile.BadZipFile, OSError, NotImplementedError) as error:
        raise wrong(str(path), "a whole npz file", f"{error}") from error


def wrong(where: str, expected: str, found: str, todo: str = "Write the file again.") -> InputError:
    """Return the error about one place of a file."""
    return InputError(where, expected=expected, found=found, todo=todo)


def _infos(
    path: Path, file: zipfile.ZipFile, members: Mapping[str, Member]
) -> dict[str, zipfile.ZipInfo]:
    found = [info.filename for info in file.infolist()]
    names = [name.removesuffix(".npy") for name in found]
    needed = {name for name, member in members.items() if member.required}
    if not needed <= set(names) or not set(names) <= set(members) or len(set(names)) < len(names):
        optional = [name for name, member in members.items() if not member.required]
        expected = f"the members {', '.join(name for name in members if name in needed)}"
        if optional:
            expected += f" (and, where known, {', '.join(optional)})"
        raise wrong(str(path), expected, ", ".join(names[:8]) or "nothing")
    total = sum(info.file_size for info in file.infolist())
    if total > ARRAY_BYTES:
        raise wrong(str(path), f"at most {ARRAY_BYTES} bytes of arrays", f"{total}")
    return {name: file.getinfo(f"{name}.npy") for name in members if f"{name}.npy" in found}


def _check_headers(
    path: Path,
    file: zipfile.ZipFile,
    infos: Mapping[str, zipfile.ZipInfo],
    members: Mapping[str, Member],
) -> None:
    """Check every declared shape before allocating memory for it."""
    sizes: dict[str, int] = {}
    for name, info in infos.items():
        where, member = f"{path}: {name}", members[name]
        try:
            with file.open(info) as stream:
                shape, _, dtype = read_npy_header(stream)
                start = stream.tell()
        except Exception as error:  # a hostile header can raise nearly any exception
            raise wrong(where, "an npy array", f"{error}" or type(error).__name__) from error
        if dtype.kind not in _KINDS[member.kind]:
            raise wrong(where, _MEANINGS[member.kind], dtype.str)
        fits = len(shape) == len(member.dims) and all(
            n == (sizes.setdefault(dim, n) if isinstance(dim, str) else dim)
            for n, dim in zip(shape, member.dims, strict=True)
        )
        if not fits:
            known = ", ".join(str(sizes.get(str(dim), dim)) for dim in member.dims)
            raise wrong(where, f"shape ({known})", f"{shape}")
        if start + math.prod(shape) * dtype.itemsize != info.file_size:
            raise wrong(where, f"the bytes of shape {shape}", f"{info.file_size - start} bytes")


def _array(
    path: Path, file: zipfile.ZipFile, info: zipfile.ZipInfo, member: Member
) -> NDArray[Any]:
    try:
        with file.open(info) as stream:
            array = read_npy(stream)
            stream.read()  # to the end, where the checksum is verified
    except MemoryError:
        raise
    except Exception as error:  # see _check_headers
        raise wrong(f"{path}: {info.filename}", "a whole array", f"{error}") from error
    return np.ascontiguousarray(array, _READ_AS[member.kind])


PACKED_RATIO: Final = 200
"""Maximum ratio of unpacked to packed bytes: poses with much padding for absent people reach 50."""

PACKED_BYTES: Final = 1 << 26
"""Unpacked bytes up to which any ratio is allowed."""


def read_npz(path: Path, limit: int) -> dict[str, NDArray[np.generic]]:
    """Return all arrays of an npz file by name.

    Args:
        path: written by `numpy.savez` or `numpy.savez_compressed`.
        limit: maximum unpacked size of all arrays together [byte].

    Raises:
        InputError: the file is no npz, truncated or too large, or has Python objects or
            inconsistent sizes; the error names file and member.
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
            shape, fortran, dtype = read_npy_header(member)
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
        InputError: the arrays are too large, or compressed too much; the error names the file.
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
            return np.ascontiguousarray(read_npy(member))
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes can raise nearly anything, as in read_header
        raise npz_error(f"{path}: {info.filename}", "a whole array", _brief(error)) from error


def npz_error(where: str, expected: str, found: str) -> InputError:
    """Return the error about a place of an npz file."""
    return InputError(where, expected=expected, found=found, todo="Write or export it again.")


def _brief(error: Exception) -> str:
    text = str(error) or type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."
