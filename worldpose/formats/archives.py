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

from worldpose.errors import InputError, say_failure
from worldpose.formats.files import whole_file
from worldpose.parsing import Header, read_npy, read_npy_header

ARRAY_BYTES: Final = 16 << 30
"""Maximum size of one file's arrays [byte]: two hours of 25 people with covariance at 50
frames/s are 13 GB."""
PACKED_RATIO: Final = 200
"""Maximum ratio of unpacked to packed bytes of arrays from elsewhere: poses with much padding for
absent people reach 50."""
PACKED_BYTES: Final = 1 << 26
"""Unpacked bytes up to which any ratio is allowed."""


@dataclass(frozen=True)
class Member:
    """Expected form of one array of an archive."""

    dims: tuple[str | int, ...]
    """Lengths, or names of lengths that must agree between members."""
    kind: Literal["float", "int", "text"]
    """Read as float64, int64 or str, whatever the width in the file."""
    required: bool = True
    dtype: str | None = None
    """The only type that is allowed, which is also kept, such as `<f4`; None = any width."""


def write_archive(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as npz, whole or not at all; equal arrays give equal bytes.

    The file has no compression, since a compressor's output changes with its version.
    """
    with whole_file(path) as draft, zipfile.ZipFile(draft, "w") as file:
        for name, array in arrays.items():
            little = np.asarray(array, array.dtype.newbyteorder("<"), order="C")
            # A ZipInfo created by name alone has the fixed date 1980-01-01.
            with file.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                npy.write_array(member, little, version=(1, 0), allow_pickle=False)


def read_archive(
    path: Path, members: Mapping[str, Member], only: Collection[str] | None = None
) -> dict[str, NDArray[Any]]:
    """Read the float64, int64 and str arrays of an npz file; check types, shapes and sizes.

    No members but these are allowed, and optional ones may be absent. `only` names those to load.
    """
    if not path.is_file():
        raise wrong(str(path), "an npz file", "nothing", "Check the path.")
    with open_npz(path) as file:
        infos, _ = check_members(path, file, members)
        require_size(path, infos.values(), ARRAY_BYTES)
        return {
            name: read_array(path, file, info, members[name])
            for name, info in infos.items()
            if only is None or name in only
        }


def wrong(
    where: str, expected: str, found: str, todo: str = "Write or export it again."
) -> InputError:
    """Return the error about one place of a file."""
    return InputError(where, expected=expected, found=found, todo=todo)


def read_npz(path: Path, limit: int) -> dict[str, NDArray[np.generic]]:
    """Return all arrays of an npz file of `numpy.savez` or `savez_compressed` by name.

    InputError if they have more than `limit` bytes unpacked, Python objects or inconsistent sizes.
    """
    with open_npz(path) as file:
        infos = [info for info in file.infolist() if info.filename.endswith(".npy")]
        for info in infos:
            _read_header(path, file, info)
        require_size(path, infos, limit, PACKED_RATIO)
        return {info.filename.removesuffix(".npy"): read_array(path, file, info) for info in infos}


def open_npz(path: Path) -> zipfile.ZipFile:
    """Return the archive; InputError if the file is none."""
    try:
        return zipfile.ZipFile(path)
    # ValueError and NotImplementedError: a damaged directory, or one of a later version.
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise wrong(str(path), "a whole npz file", say_failure(error)) from error


def check_members(
    path: Path, file: zipfile.ZipFile, members: Mapping[str, Member]
) -> tuple[dict[str, zipfile.ZipInfo], dict[str, int]]:
    """Return an archive's entries by name, and named lengths; InputError if not `members`."""
    found = [info.filename for info in file.infolist()]
    names = [name.removesuffix(".npy") for name in found]
    needed = [name for name, member in members.items() if member.required]
    if not {*needed} <= {*names} <= {*members} or len(set(names)) < len(names):
        optional = [name for name in members if name not in needed]
        expected = f"the members {', '.join(needed)}"
        if optional:
            expected += f" (and, where known, {', '.join(optional)})"
        raise wrong(str(path), expected, ", ".join(names[:8]) or "nothing")
    infos = {name: file.getinfo(f"{name}.npy") for name in members if f"{name}.npy" in found}
    sizes: dict[str, int] = {}
    kinds = {"float": "f", "int": "iu", "text": "U"}
    meanings = {"float": "float numbers", "int": "int numbers", "text": "text"}
    for name, info in infos.items():
        where, member = f"{path}: {name}", members[name]
        shape, _, dtype = _read_header(path, file, info)
        if member.dtype is not None and dtype != np.dtype(member.dtype):
            exact = np.dtype(member.dtype)
            raise wrong(where, f"{exact.str} ({exact.name}, little-endian)", dtype.str)
        if dtype.kind not in kinds[member.kind]:
            raise wrong(where, meanings[member.kind], dtype.str)
        fits = len(shape) == len(member.dims) and all(
            n == (sizes.setdefault(dim, n) if isinstance(dim, str) else dim)
            for n, dim in zip(shape, member.dims, strict=True)
        )
        if not fits:
            known = ", ".join(str(sizes.get(str(dim), dim)) for dim in member.dims)
            raise wrong(where, f"shape ({known})", f"{shape}")
    return infos, sizes


def _read_header(path: Path, file: zipfile.ZipFile, info: zipfile.ZipInfo) -> Header:
    """Return the header of a member, checked against its size."""
    where = f"{path}: {info.filename}"
    try:
        with file.open(info) as member:
            shape, fortran, dtype = read_npy_header(member)
            start = member.tell()
    except Exception as error:  # a hostile header can raise nearly anything in numpy and zipfile
        raise wrong(where, "an npy array", say_failure(error)) from error
    if dtype.hasobject:
        raise wrong(where, "numbers", "Python objects, which are never loaded")
    size = start + math.prod(shape) * dtype.itemsize
    if size != info.file_size or min(shape, default=0) < 0:
        raise wrong(where, f"{size} bytes for its shape {shape}", f"{info.file_size} bytes")
    return shape, fortran, dtype


def require_size(
    path: Path, infos: Collection[zipfile.ZipInfo], limit: int, ratio: int | None = None
) -> None:
    """Raise InputError for arrays beyond `limit` bytes, and for excessive compression ratios."""
    total = sum(info.file_size for info in infos)
    # The archive's directory may state more bytes than the file has.
    packed = min(sum(info.compress_size for info in infos), path.stat().st_size)
    expected = None
    if total > limit:
        expected = f"at most {limit} bytes of arrays"
    elif ratio is not None and total > max(PACKED_BYTES, packed * ratio):
        expected = f"arrays packed at most {ratio} to 1"
    if expected is not None:
        todo = (
            "Give dimensions no more room than their entries need, or save the arrays "
            "without compression."
        )
        raise InputError(str(path), expected, f"{total} bytes of arrays in {packed}", todo)


def read_array(
    path: Path, file: zipfile.ZipFile, info: zipfile.ZipInfo, form: Member | None = None
) -> NDArray[Any]:
    """Return a member's array, in the type of its form; check its header and size first."""
    read_as = {"float": np.float64, "int": np.int64, "text": np.str_}
    dtype = None if form is None else form.dtype or read_as[form.kind]
    try:
        with file.open(info) as member:
            array = read_npy(member)
            member.read()  # to the end, where the checksum is verified
        return np.ascontiguousarray(array, dtype)
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes can raise nearly anything, as in _read_header
        raise wrong(f"{path}: {info.filename}", "a whole array", say_failure(error)) from error
