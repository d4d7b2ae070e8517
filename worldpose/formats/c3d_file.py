"""C3D file of one person's joints, as motion capture software reads it."""

from __future__ import annotations

import struct
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks

BLOCK: Final = 512
"""Size of the blocks that a C3D file consists of [byte]."""
HEADER_FRAMES: Final = 65535
"""The header counts frames in 16 bits; POINT:LONG_FRAMES and TRIAL:ACTUAL_END_FIELD count more."""
MAX_DIMENSION: Final = 255
"""A dimension of a parameter has 8 bits."""
_Value = str | Sequence[str] | np.generic | NDArray[np.generic]


def write_c3d(
    path: Path, tracks: JointTracks, person: int, fps: float, notes: Mapping[str, str]
) -> None:
    """Write the joints of one person, an index in `tracks`, as a C3D file, whole or not at all.

    Points are the 17 joints, and heels and toes where the clip has them, in millimetres, x, y and z
    as in the world, z up, in single precision: 0.004 mm at 60 m. Frame 1 is the first frame of
    `tracks`, and frames cover all up to the last, so that the files of all people of a clip agree
    in time. The residual of a joint is its standard deviation, the mean over the axes, in whole
    millimetres from 1; it is 0, which the format reserves for computed points, if no camera
    contributes, and -1 if the joint is missing. Events mark the clip's begin and end, and group
    WORLDPOSE holds the notes, of which `name` is the subject's. InputError for a note that is too
    long, and for no or too many frames.
    """
    # LONG_FRAMES is a number of single precision: 46 hours at 100 frames per second.
    max_frames = 1 << 24
    count = int(tracks.frames[-1] - tracks.frames[0]) + 1 if len(tracks.frames) else 0
    if not 1 <= count <= max_frames:
        expected = f"1 to {max_frames} frames, which C3D can count"
        todo = "Choose another format, such as parquet, or shorter clips."
        raise InputError(str(path), expected, f"{count}", todo)
    names = tracks.markers.points
    subject = notes.get("name") or f"person_{tracks.person_ids[person]}"
    parameters = _parameters(subject, names, count, fps, notes)
    # The start of the data is itself a parameter, whose length does not depend on its value.
    start = 2 + len(_pad(_parameter_section(path, parameters))) // BLOCK
    parameters["POINT"]["DATA_START"] = np.int16(start)
    section = _parameter_section(path, parameters)
    content = [
        _header(len(names), count, fps, start),
        section,
        _points(tracks, person, count).tobytes(),
    ]
    with whole_file(path) as draft:
        draft.write_bytes(b"".join(_pad(part) for part in content))


def _points(tracks: JointTracks, person: int, count: int) -> NDArray[np.float32]:
    """Return x, y, z [mm] and the residual [mm] of each frame and point (count, points, 4)."""
    max_residual_mm = 255  # A residual has 8 bits, and the file's scale is 1 mm
    markers = tracks.markers
    joints = markers.joints[:, person]
    there = np.isfinite(joints[..., 0])
    residual = np.ones(there.shape)
    if markers.covariance is not None:
        variance = np.diagonal(markers.covariance[:, person], axis1=-2, axis2=-1).mean(-1)
        std_mm = 1000.0 * np.sqrt(np.where(np.isfinite(variance), variance, 0.0))
        residual = np.clip(np.round(std_mm), 1, max_residual_mm)
    if markers.views is not None:
        residual[markers.views[:, person] == 0] = 0.0
    rows = np.zeros((count, len(markers.points), 4), np.float32)
    rows[..., 3] = -1.0
    found = np.concatenate([joints * 1000.0, residual[..., None]], axis=-1)
    rows[tracks.frames - tracks.frames[0]] = np.where(
        there[..., None], found, np.array([0.0, 0.0, 0.0, -1.0])
    )
    return rows


def _header(points: int, count: int, fps: float, start: int) -> bytes:
    """Return the first block: sizes, rate, and that event labels have four characters."""
    sizes = struct.pack("<BB5H", 2, 0x50, points, 0, 1, min(count, HEADER_FRAMES), 0)
    # A negative scale announces floats; its absolute value is the unit of residuals.
    rates = struct.pack("<fHHf", -1.0, start, 0, fps)
    return sizes + rates


def _parameters(
    subject: str, points: Sequence[str], count: int, fps: float, notes: Mapping[str, str]
) -> dict[str, dict[str, _Value]]:
    """Return parameters by group and name."""
    begin_end = [[0.0, 0.0], [0.0, (count - 1) / fps]]  # minutes, seconds
    zero = np.int16(0)
    return {
        "POINT": {
            "USED": np.int16(len(points)),
            "FRAMES": np.uint16(min(count, HEADER_FRAMES)).astype(np.int16),
            **({"LONG_FRAMES": np.float32(count)} if count > HEADER_FRAMES else {}),
            "DATA_START": zero,
            "SCALE": np.float32(-1.0),
            "RATE": np.float32(fps),
            "LABELS": list(points),
            "DESCRIPTIONS": [name.replace("_", " ") for name in points],
            "UNITS": "mm",
            "X_SCREEN": "+X",
            "Y_SCREEN": "+Z",
        },
        "ANALOG": {"USED": zero, "GEN_SCALE": np.float32(1.0), "RATE": np.float32(0.0)},
        "FORCE_PLATFORM": {"USED": zero},
        "TRIAL": {
            # Pairs of the low and the high 16 bits.
            "ACTUAL_START_FIELD": np.array([1, 0], np.int16),
            "ACTUAL_END_FIELD": np.array([count & 0xFFFF, count >> 16], np.uint16).astype(np.int16),
            "CAMERA_RATE": np.float32(fps),
        },
        "SUBJECTS": {"USED": np.int16(1), "IS_STATIC": zero, "NAMES": [subject]},
        "EVENT": {
            "USED": np.int16(2),
            "CONTEXTS": ["General", "General"],
            "LABELS": ["Clip begin", "Clip end"],
            "DESCRIPTIONS": ["first frame of the clip", "last frame of the clip"],
            "SUBJECTS": [subject, subject],
            "TIMES": np.array(begin_end, np.float32),
            "ICON_IDS": np.zeros(2, np.int16),
            "GENERIC_FLAGS": np.zeros(2, np.int16),
        },
        "MANUFACTURER": {"COMPANY": "worldpose", "SOFTWARE": "worldpose"},
        "WORLDPOSE": {name.upper(): _wrap(text) for name, text in notes.items()},
    }


def _wrap(text: str) -> str | list[str]:
    """Return a text that fits one line as it is, and a longer one as lines."""
    line_characters = 80  # length of the lines into which longer texts are wrapped
    if len(text.encode()) <= MAX_DIMENSION and "\n" not in text:
        return text
    return [
        piece
        for line in text.splitlines()
        for piece in textwrap.wrap(line, line_characters) or [""]
    ]


def _parameter_section(path: Path, parameters: Mapping[str, Mapping[str, _Value]]) -> bytes:
    """Return the blocks of parameters, whose first bytes count them."""
    records = []
    for number, (group, members) in enumerate(parameters.items(), start=1):
        records.append(_record(group, -number, b""))
        for name, value in members.items():
            data = _encode(f"{path}: {group}:{name}", value)
            records.append(_record(name, number, data))
    body = b"".join(records) + b"\0\0"
    blocks = -(-(len(body) + 4) // BLOCK)
    return bytes([1, 0x50, blocks, 84]) + body  # 84: little-endian IEEE floats


def _record(name: str, number: int, data: bytes) -> bytes:
    """Return a group (negative number) or a parameter, without a description."""
    rest = data + b"\0"
    return (
        struct.pack("<bb", len(name), number)
        + name.encode("ascii")
        + struct.pack("<H", len(rest) + 2)
        + rest
    )


def _encode(where: str, value: _Value) -> bytes:
    """Return kind, dimensions and data of a parameter, first dimension fastest."""
    # Maximum length of a text parameter, whose size has 15 bits, with its padding [byte].
    max_text_bytes = 32000
    kinds = {"char": -1, "int16": 2, "float32": 4}
    if isinstance(value, str):
        text = value.encode()
        return struct.pack("<bBB", kinds["char"], 1, len(text)) + text
    if isinstance(value, Sequence):
        rows = [row.encode() for row in value]
        width = max(map(len, rows), default=0)
        if max(width, len(rows)) > MAX_DIMENSION or width * len(rows) > max_text_bytes:
            expected = f"a text of at most {MAX_DIMENSION} lines and {max_text_bytes} bytes"
            todo = "Give a shorter text, such as the licence's name and address."
            raise InputError(where, expected, f"{len(rows)} lines of {width} bytes", todo)
        sizes = struct.pack("<bBBB", kinds["char"], 2, width, len(rows))
        return sizes + b"".join(row.ljust(width) for row in rows)
    sizes = struct.pack("<bB", kinds[value.dtype.name], value.ndim) + bytes(value.shape[::-1])
    return sizes + value.tobytes()


def _pad(content: bytes) -> bytes:
    return content + b"\0" * (-len(content) % BLOCK)
