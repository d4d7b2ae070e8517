"""Python literals and sources, npy arrays, and cells of tables, parsed also while others parse.

Python 3.11 keeps one recursion depth for the syntax trees of all threads (python/cpython issue
106905). If a thread begins a tree while another thread is within one, the other one ends with a
SystemError. NumPy reads the header of an npy array as a syntax tree, so that it would refuse a good
file. The headers are read here without a tree; Python text is parsed through `parse_in_turn`.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import lzma
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Collection
from pathlib import Path
from threading import RLock
from typing import IO, Any, Final, TypeVar

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from worldpose.errors import InputError, say_failure

Result = TypeVar("Result")


Header = tuple[tuple[int, ...], bool, np.dtype[np.generic]]
"""Shape, whether in Fortran order, type."""

_HEADER_ITEM: Final = re.compile(
    r"\s*(?:'descr'\s*:\s*'(?P<descr>[<>|=]?[A-Za-z]\d*(?:\[\w+\])?)'"
    r"|'fortran_order'\s*:\s*(?P<fortran>True|False)"
    r"|'shape'\s*:\s*\((?P<shape>[-\d\sL,]*)\))\s*(?:,|(?=\}))\s*"
)
"""One item of the header of an npy array with plain values, in any order of items."""

# Reentrant: garbage collection can run any code while a tree is made.
_TURN = RLock()


def parse_in_turn(parse: Callable[[], Result]) -> Result:
    """Return the result of `parse`, which makes a syntax tree; threads take turns here.

    A library can still parse in another thread, so a SystemError leads to another attempt.
    """
    # Attempts to parse; where a library parsed without pause, two failed one after another at
    # most.
    attempts = 10
    for _ in range(attempts - 1):
        try:
            with _TURN:
                return parse()
        except SystemError:
            continue
    with _TURN:
        return parse()


def read_npy_header(stream: IO[bytes]) -> Header:
    """Return the header of the npy array at the start of a stream; the array's bytes follow.

    ValueError if this is no npy array of version 1.0, or one of records.
    """
    if npy.read_magic(stream) != (1, 0):
        raise ValueError("another version than npy 1.0")  # later ones allow headers of 4 GB
    length = int.from_bytes(stream.read(2), "little")
    text = stream.read(length).decode("latin-1").strip()
    found: dict[str, str] = {}
    end = 1
    while item := _HEADER_ITEM.match(text, end):
        found |= {key: value for key, value in item.groupdict().items() if value is not None}
        end = item.end()
    if len(found) < 3 or text[:1] != "{" or text[end:] != "}":
        raise ValueError(f"another header than of plain values: {text[:80]!r}")
    shape = tuple(int(size.strip("L ")) for size in found["shape"].split(",") if size.strip())
    try:
        return shape, found["fortran"] == "True", np.dtype(found["descr"])
    except TypeError as error:
        raise ValueError(f"{error}") from error


def read_npy(stream: IO[bytes]) -> NDArray[np.generic]:
    """Return the npy array at the start of a stream; Python objects are refused unread.

    ValueError if this is no npy array of plain values, or it is truncated.
    """
    block_bytes = 1 << 18  # bytes read at a time: an unpacked block fits into a processor's cache
    shape, is_fortran, dtype = read_npy_header(stream)
    if dtype.hasobject:
        raise ValueError("Python objects, which are never loaded")
    content = np.empty(math.prod(shape) * dtype.itemsize, np.uint8)
    for start in range(0, len(content), block_bytes):
        part = content[start : start + block_bytes]
        block = stream.read(len(part))
        if len(block) < len(part):
            raise ValueError(f"the array ends after {start + len(block)} of {len(content)} bytes")
        part[:] = np.frombuffer(block, np.uint8)
    return np.ndarray(shape, dtype, content, order="F" if is_fortran else "C")


def read_npz_members(path: Path, names: Collection[str]) -> dict[str, NDArray[Any]]:
    """Return those arrays of an npz file that are among `names`; others are not read.

    ValueError if one is damaged or holds Python objects, zipfile.BadZipFile if the file is.
    """
    with zipfile.ZipFile(path) as file:
        found = {info.filename.removesuffix(".npy"): info for info in file.infolist()}
        arrays = {}
        for name in names:
            if name in found:
                with file.open(found[name]) as member:
                    arrays[name] = read_npy(member)
        return arrays


DECIMAL_COMMA: Final = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
THOUSANDS: Final = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
DECIMAL_POINT: Final = re.compile(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?")


def decimal_point(text: str) -> str:
    """Return the text of a number with a point for its decimal comma."""
    return text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else text


def clock_seconds(cell: object) -> float:
    """Return the seconds of a number, or of [HH:]MM:SS.fff, perhaps after days or a date.

    The frames of a time code, HH:MM:SS:FF, are left out; NaN for any other text.
    """
    text = str(cell).strip()
    days, clock = r"(?:(-?\d+) days?,? |.*[ T])?", r"([-+]?)(?:(\d+):)?(\d+):(\d\d(?:[.,]\d+)?)"
    if found := re.fullmatch(days + clock + r"(?:[:;]\d\d)?(?:Z|[+-]\d\d:?\d\d)?", text):
        day, sign, *parts = found.groups()
        hours, minutes, seconds = (float((each or "0").replace(",", ".")) for each in parts)
        within = 3600.0 * hours + 60.0 * minutes + seconds
        return 86400.0 * float(day or 0) + (-within if sign == "-" else within)
    number = re.fullmatch(r"-?\d+(?:[.,]\d+)?(?:e[-+]?\d+)?", text.lower())
    return float(text.replace(",", ".")) if number else math.nan


def read_cells(path: Path, limit: int, todo: str) -> tuple[list[tuple[int, list[str]]], bool]:
    """Return the rows of a table as spreadsheets save it, and whether it has decimal commas.

    Text is UTF-8, UTF-16 with its mark, or Windows-1252; cells are separated by commas, semicolons
    or tabs. Rows are numbered from 1; empty ones, and empty columns at the end, are left out.
    InputError, with `todo`, for more than `limit` bytes, a workbook in place of text, or no table.
    """
    try:
        if not path.is_file():
            raise ValueError("something else" if path.exists() else "nothing")
        if path.stat().st_size > limit:
            raise ValueError(f"{path.stat().st_size} bytes, more than {limit}")
        lines = decode_table(path.read_bytes(), limit).splitlines()
        hint = re.fullmatch(r"sep=(.)\W*", lines[0]) if lines else None  # of Excel
        if hint is not None:
            lines[0] = ""
        first = next((each for each in lines if each.strip()), "")
        separator = hint[1] if hint is not None else max(",;\t", key=first.count)
        cells = enumerate(csv.reader(lines, delimiter=separator), 1)
        rows = [(number, row) for number, row in cells if any(map(str.strip, row))]
        width = max(
            (n for _, row in rows for n, cell in enumerate(row, 1) if cell.strip()), default=0
        )
        rows = [(number, row[:width]) for number, row in rows]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            str(path), expected="text in rows and columns", found=say_failure(error), todo=todo
        ) from error
    numbers = [cell.strip() for _, row in rows for cell in row]
    commas = [cell for cell in numbers if DECIMAL_COMMA.fullmatch(cell)]
    # Between commas, a number in quotes such as "1,500" may be one with a sign of thousands.
    has_commas = any(separator != "," or not THOUSANDS.fullmatch(cell) for cell in commas)
    if has_commas and any(DECIMAL_POINT.fullmatch(cell) for cell in numbers):
        raise InputError(
            str(path),
            expected="one decimal sign",
            found="numbers with a point and numbers with a comma",
            todo="Save the table with one decimal sign, and without signs between thousands.",
        )
    return rows, has_commas


def _unpack(content: bytes, most: int) -> bytes:
    """Return the only file of a zip archive, or that of gzip; other bytes as they are."""
    try:
        if content.startswith(b"\x1f\x8b"):
            with gzip.open(io.BytesIO(content)) as packed:
                content = packed.read(most + 1)
        elif content.startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                names = [
                    n for n in archive.namelist() if not re.search(r"/$|(^|/)(\.|__MACOSX/)", n)
                ]
                if {"[Content_Types].xml", "content.xml"} & {*names}:
                    raise ValueError("a workbook, not text: save it as CSV")
                if len(names) != 1:
                    found = f"{len(names)} files, {', '.join(names):.200}"
                    raise ValueError(f"an archive of {found}: give one of them")
                with archive.open(names[0]) as file:
                    content = file.read(most + 1)
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError) as error:
        raise ValueError(f"a damaged or locked archive: {error}") from error
    if len(content) > most:
        raise ValueError(f"an archive of more than {most} bytes")
    return content


def decode_table(content: bytes, most: int = 1 << 30) -> str:
    """Return the text of a table of at most so many bytes, perhaps the only one in an archive."""
    content = _unpack(content, most)
    if content.startswith(b"\xd0\xcf\x11\xe0"):
        raise ValueError("a workbook, not text: save it as CSV")
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if b"\0" in content:
        raise ValueError("bytes that are no text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252")
