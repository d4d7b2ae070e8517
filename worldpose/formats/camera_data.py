"""Camera data of broadcast tracking systems: FreeD packets, and tables with a row per image.

FreeD packets stand one after another, or in a capture of a network (pcap or pcapng), which has
their times.

FreeD's conventions hold for all forms: a right-handed world with z up; pan from the y axis
clockwise as seen from above, tilt upwards, roll clockwise as seen from behind the camera.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.conventions import UNITS
from worldpose.errors import InputError
from worldpose.formats.calibration_unit import other_middle
from worldpose.formats.tables import write_rows
from worldpose.parsing import clock_seconds, read_cells

_BYTES: Final = 1 << 26
"""Maximum size of a file [byte]: twelve hours of packets at 50 Hz."""
_LENGTH: Final = 29
"""Length of a FreeD packet with a camera's position, of type D1 [byte]."""
COLUMNS: Final = (
    *("pan", "tilt", "roll", "x_m", "y_m", "z_m", "focal_px", "k1", "k2", "zoom"),
    *("cx_px", "cy_px"),
)
"""Columns of a table of camera data in a match folder, beside `frame`."""
COUNTS: Final = "zoom counts are no focal length: without --zoom-table, they are compared alone"
"""Note of data whose zoom is in counts."""


@dataclass(frozen=True, eq=False)
class CameraData:
    """What a tracking system states about one camera.

    Attributes:
        frame: (rows,) numbers of the images in the video, rising.
        values: (rows, 12) as COLUMNS: angles [deg], center [m], focal length [px], OpenCV's k1 and
            k2 [1], counts of the zoom, which only rise or only fall with the focal length, and the
            principal point [px]; NaN where nothing is stated.
        notes: sentences about what was assumed and left out.
    """

    frame: Integers
    values: Floats
    notes: tuple[str, ...] = ()


def write_camera_data(path: Path, data: CameraData) -> None:
    """Write camera data as a table that `read_camera_data` reads, without empty columns."""
    known = np.flatnonzero(np.isfinite(data.values).any(axis=0))
    head = ",".join(["frame", *(COLUMNS[n] for n in known)])
    write_rows(path, [head], [(data.frame, "%d"), (data.values[:, known], "%.9g")], ",")


def read_camera_data(
    path: Path, fps: float, size: tuple[int, int], first: int | None = None, *, number: int = -1
) -> CameraData:
    """Return the camera data of a file.

    It has FreeD packets one after another, or in a capture (pcap), or a table (CSV, TSV). `fps`
    [1/s] of the video serves time codes and captures, `size`, width and height [px], fields of
    view. `first` is the number in the video of the first row; None = the table's number, else 0.
    `number` is FreeD's of the camera; -1 = there is only one.
    """
    content = b""
    if path.is_file() and path.stat().st_size <= _BYTES:
        content = path.read_bytes()
    if content.startswith(b"\xd1"):
        data = _read_freed(path, content, number)
    elif content[:4] in (*_CAPTURES, _BLOCKS):
        data = _read_capture(path, content, number, fps)
    else:
        data = _read_table(path, fps, size)
    frame = data.frame if first is None else data.frame - data.frame[0] + first
    falls = np.flatnonzero(np.diff(frame) <= 0)
    if len(falls):
        row = int(falls[0])
        found = f"{frame[row]}, then {frame[row + 1]}"
        raise _wrong(f"{path}: entry {row + 2}", "frames that rise, each once", found)
    # Largest absolute values of these columns.
    limits = (360.0, 90.0, 180.0, 300.0, 300.0, 300.0, 1e6, 1e3, 1e3, 1e9, 1e5, 1e5)
    with np.errstate(invalid="ignore"):
        off = (np.abs(data.values) > limits) | (data.values[:, [6]] < 1.0) & (
            np.arange(len(COLUMNS)) == 6
        )
    for row, column in np.argwhere(off)[:1]:
        where = f"{path}: entry {row + 1}: {COLUMNS[column]}"
        expected = f"at most {limits[column]:g}" + (", at least 1" if column == 6 else "")
        todo = "Correct it, or state the unit in the title, as in x_mm."
        raise _wrong(where, expected, f"{data.values[row, column]:.7g}", todo)
    return replace(data, frame=frame)


def _read_freed(path: Path, content: bytes, number: int) -> CameraData:
    """Return the camera data of FreeD packets of one camera.

    Angles are signed 24-bit numbers of 1/32768 degree, positions of 1/64 mm. Zoom is a count.
    """
    packets = [content[at : at + _LENGTH] for at in range(0, len(content), _LENGTH)]
    for count, packet in enumerate(packets, 1):
        if not _is_freed(packet):
            checksum = (0x40 - sum(packet[:-1])) % 256
            expected = f"{_LENGTH} bytes of type D1 with the checksum {checksum:02X}"
            found = f"{len(packet)} bytes of type {packet[0]:02X} with {packet[-1]:02X}"
            todo = "Cut the packet out, or record them again."
            raise _wrong(f"{path}: packet {count}", expected, found, todo)
    ids = [packet[1] for packet in packets]
    if number not in (set(ids) if len(set(ids)) > 1 else {-1, *ids}):
        counts = (f"{ids.count(each)} of camera {each}" for each in sorted(set(ids)))
        expected = "packets of one camera" if number < 0 else f"packets of camera {number}"
        todo = "Name the camera by --freed-camera NUMBER."
        raise _wrong(str(path), expected, ", ".join(counts), todo)
    kept = [packet for packet, own in zip(packets, ids, strict=True) if number in (-1, own)]
    raw = np.frombuffer(b"".join(kept), np.uint8).reshape(-1, _LENGTH)[:, 2:23].astype(np.int64)
    counts_24 = raw.reshape(-1, 7, 3) @ np.array([65536, 256, 1])
    signed = counts_24 - (counts_24 >= 1 << 23) * (1 << 24)
    values = np.full((len(raw), len(COLUMNS)), np.nan)
    values[:, :3], values[:, 9] = signed[:, :3] / 32768.0, counts_24[:, 6]
    notes = [COUNTS, "packets have no times: each is one frame of the video"]
    if signed[:, 3:6].any():
        values[:, 3:6] = signed[:, 3:6] / 64e3
    else:
        notes.append("the packets state no position")
    return CameraData(np.arange(len(raw)), values, tuple(notes))


_CAPTURES: Final = {
    bytes.fromhex("d4c3b2a1"): ("<", 1e-6),
    bytes.fromhex("a1b2c3d4"): (">", 1e-6),
    bytes.fromhex("4d3cb2a1"): ("<", 1e-9),
    bytes.fromhex("a1b23c4d"): (">", 1e-9),
}
"""Order of bytes and unit of times [s] of pcap, by its first bytes."""
_BLOCKS: Final = bytes.fromhex("0a0d0d0a")
"""First bytes of pcapng."""


def _read_capture(path: Path, content: bytes, number: int, fps: float) -> CameraData:
    """Return the camera data of a network's capture, at the frames of the packets' times.

    The frames of the network that end in a FreeD packet count, whatever they are wrapped in; of
    several packets at one frame of the video the nearest counts.
    """
    try:
        found = list(_blocks(content) if content[:4] == _BLOCKS else _records(content))
    except struct.error as error:
        raise _wrong(str(path), "a whole capture", str(error), "Record it again.") from error
    packets = [(time, data[-_LENGTH:]) for time, data in found if _is_freed(data[-_LENGTH:])]
    if not packets:
        todo = "Capture the port of the tracking system: tcpdump -w FILE udp port NUMBER."
        raise _wrong(str(path), "FreeD packets", f"none in {len(found)} frames", todo)
    data = _read_freed(path, b"".join(packet for _, packet in packets), number)
    times = np.array([time for time, packet in packets if number in (-1, packet[1])])
    frame, rows = _at_frames(times, fps)
    note = f"{len(times)} packets by the capture's times; the first is frame 0 of the video"
    return CameraData(frame, data.values[rows], (COUNTS, note, *data.notes[2:]))


def _at_frames(times: Floats, fps: float) -> tuple[Integers, Integers]:
    """Return frames from that of the first time [s] on, and for each the row that is nearest."""
    exact = (times - times[0]) * fps
    slot = np.rint(exact).astype(np.int64)
    order = np.lexsort((np.abs(exact - slot), slot))
    frame, first = np.unique(slot[order], return_index=True)
    return frame, order[first]


def _is_freed(packet: bytes) -> bool:
    return len(packet) == _LENGTH and packet[0] == 0xD1 and sum(packet) % 256 == 0x40


def _records(content: bytes) -> Iterator[tuple[float, bytes]]:
    """Yield times [s] and frames of the network of a pcap file."""
    order, unit = _CAPTURES[content[:4]]
    at = 24
    while at < len(content):
        seconds, parts, length, _ = struct.unpack_from(f"{order}4I", content, at)
        if at + 16 + length > len(content):
            raise struct.error("it ends within a packet")
        yield seconds + unit * parts, content[at + 16 : at + 16 + length]
        at += 16 + length


def _blocks(content: bytes) -> Iterator[tuple[float, bytes]]:
    """Yield times [s] and frames of the network of a pcapng file."""
    at, units = 0, []
    order = "<" if content[8:12] == bytes.fromhex("4d3c2b1a") else ">"
    while at < len(content):
        kind, size = struct.unpack_from(f"{order}2I", content, at)
        if size < 12 or at + size > len(content):
            raise struct.error(f"a block of {size} bytes at byte {at} of {len(content)}")
        if kind == 1:  # an interface; its option 9 is the resolution of times
            step = re.match(rb"(?s)(?:.{4})*?(?:\x09\0\x01\0|\0\x09\0\x01)(.)", content[at + 16 :])
            power = step[1][0] if step and at + 16 + step.end() <= at + size else 6
            units.append(2.0 ** -(power & 127) if power & 128 else 10.0**-power)
        elif kind == 6:  # a packet
            which, high, low, length = struct.unpack_from(f"{order}4I", content, at + 8)
            yield units[which] * (high * 2**32 + low), content[at + 28 : at + 28 + length]
        at += size


_TITLES: Final[Mapping[str, str]] = {
    **{"frame_number": "frame", "frame_no": "frame", "tc": "timecode", "time_code": "timecode"},
    **{"focal_length_px": "focal_px", "focal_length_mm": "focal_mm", "vfov": "fov_y"},
    **dict.fromkeys(("fov_x", "hfov", "fov_h", "fovx", "fov_horizontal", "horizontal_fov"), "fov"),
    **dict.fromkeys(("fov_v", "fovy", "fov_vertical", "vertical_fov"), "fov_y"),
}
"""Other names of columns; `_deg` or `_rad` may follow those of angles, a unit of length x, y, z."""
_TIME: Final = re.compile(r"(?:time|timestamp|time_stamp|t|seconds)(?:_(s|sec|ms|us))?")
_SECONDS: Final = {"ms": 1e-3, "us": 1e-6}
_KNOWN: Final = {
    *("frame", "timecode", *COLUMNS, "focal_mm", "sensor_width_mm", "fov", "fov_y", "cx", "cy")
}


def _read_columns(
    path: Path, needed: Sequence[str]
) -> tuple[dict[str, Floats], list[str], list[str]]:
    """Return the numbers of known columns, cells of time codes, and titles of unknown columns."""
    todo = "Name the columns so; x, y and z may have a unit, as in x_mm."
    rows, has_commas = read_cells(path, _BYTES, todo)
    columns: dict[str, Floats] = {}
    codes, left_out = [], []
    metres = {"": 1.0} | {unit: each[0] for unit, each in UNITS.items()}
    for place, title in enumerate(rows[0][1] if rows else ()):
        text = re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_").removesuffix("_deg")
        axis = re.fullmatch(r"(?:pos_?|position_?)?([xyz])(?:_([a-z]+))?", text)
        factor = metres.get(axis[2] or "", 0.0) if axis else 1.0
        if text.endswith("_rad"):
            text, factor = text.removesuffix("_rad"), float(np.degrees(1.0))
        name = f"{axis[1]}_m" if axis and factor else _TITLES.get(text, text)
        cells = [row[place].strip() if place < len(row) else "" for _, row in rows[1:]]
        where = f"{path}: column {title}"
        if (timed := _TIME.fullmatch(text)) and "time" not in columns:
            seconds = np.array([clock_seconds(cell) for cell in cells])
            seconds *= _SECONDS.get(timed[1] or "", 1.0)
            if len(cells) > 1 and np.isfinite(seconds).all():
                # A coarse clock or a counter places no row; in a stated unit it can be a fault.
                is_stated = timed[1] and not 0.0 <= seconds[-1] - seconds[0] < len(cells) - 1.0
                if is_stated or _is_fine(seconds):
                    columns["time"] = seconds
                    continue
        if name not in _KNOWN:
            left_out.append(title.strip())
        elif name in columns:
            raise _wrong(where, "every column once", f"{name} again")
        elif name == "timecode":
            codes = cells
        else:
            columns[name] = factor * _numbers(where, cells, "," if has_commas else ".")
    if not {*needed} <= columns.keys() or len(rows) < 2:
        expected = f"rows with the columns {', '.join(needed)}, of {', '.join(sorted(_KNOWN))}"
        raise _wrong(str(path), expected, f"{len(rows)} rows, {', '.join(columns) or '-'}", todo)
    return columns, codes, left_out


def _numbers(where: str, cells: Sequence[str], decimal: str) -> Floats:
    """Return the numbers of a column; NaN where a cell is empty."""
    values = np.full(len(cells), np.nan)
    for n, text in enumerate(cells):
        try:
            values[n] = float(text.replace(decimal, ".") or "nan")
        except ValueError:
            values[n] = np.inf
        if np.isinf(values[n]):
            raise _wrong(f"{where}: entry {n + 1}", "a number", repr(text))
    return values


def _is_fine(time: Floats) -> bool:
    """Return whether times [s] rise from nearly every row to the next, in many rows a second."""
    step = np.diff(time)
    return bool((step >= 0.0).all() and np.quantile(step, 0.1) > 0.0 and np.median(step) < 1.0)


def _time_frames(path: Path, columns: dict[str, Floats], fps: float) -> tuple[Integers, str]:
    """Return the rows that count by the time of a table, with `frame` of them; and a sentence.

    InputError if times do not rise, are in no seconds, or contradict the frames.
    """
    time, are_seconds = columns["time"], _is_fine(columns["time"])
    if "frame" in columns:
        count, span = float(np.ptp(columns["frame"])), float(np.ptp(time))
        if are_seconds and abs(count - fps * span) > 1.0 + 0.05 * count:
            found = f"frames at {count / span:g} per second by their times"
            todo = "Keep the column frame if it has the video's numbers, else that of the time."
            raise _wrong(f"{path}: time", f"the video's {fps:g} per second", found, todo)
        return np.arange(len(time)), ""
    if not are_seconds:
        expected, found = "seconds that rise, in many rows a second", f"{time[:3].tolist()}"
        todo = "State the unit in the title: time_s or time_ms."
        raise _wrong(f"{path}: time", expected, found, todo)
    frame, rows = _at_frames(time, fps)
    columns["frame"] = frame.astype(np.float64)
    return rows, f"{len(time)} rows by their times; the first is frame 0 of the video"


def _read_table(path: Path, fps: float, size: tuple[int, int]) -> CameraData:
    """Return the camera data of a table with a row per image."""
    columns, codes, left_out = _read_columns(path, ("pan", "tilt"))
    _take_middle(path, columns, left_out, size)
    notes = [f"columns left out: {', '.join(left_out)}"] if left_out else []
    if any(re.search(r"[.,]\d{3,}$", code) for code in codes) and "time" not in columns:
        columns["time"], codes = np.array([clock_seconds(code) for code in codes]), []
    if "frame" not in columns and codes:
        frame = np.array([_frames(path, n, text, fps) for n, text in enumerate(codes, 1)])
        columns["frame"] = frame - frame[0]
        notes.append(f"time code {codes[0]} is the first frame")
    elif len(columns.get("time", ())) > 1:
        rows, note = _time_frames(path, columns, fps)
        frame = columns.pop("frame")
        columns = {name: values[rows] for name, values in columns.items()} | {"frame": frame}
        notes += [note] if note else []
    unknown = np.full(len(columns["pan"]), np.nan)
    if "frame" not in columns:
        notes.append("the table has no frames: each row is one frame of the video")
    frame = columns.get("frame", np.arange(len(unknown), dtype=np.float64))
    if not (np.abs(frame) < 1e9).all() or (frame != np.floor(frame)).any():
        raise _wrong(f"{path}: column frame", "whole numbers", "others")
    columns["focal_px"] = _focal_lengths(path, columns, size)
    values = np.stack([columns.get(name, unknown) for name in COLUMNS], axis=1)
    return CameraData(frame.astype(np.int64), values, tuple(notes))


def _take_middle(
    path: Path, columns: dict[str, Floats], left_out: list[str], size: tuple[int, int]
) -> None:
    """Check cx_px and cy_px, and take bare cx, cy for them; leave those out in other units."""
    for names in (("cx_px", "cy_px"), ("cx", "cy")):
        given = [np.ravel(columns.get(name, np.nan)) for name in names]
        middle = [
            float(np.nanmedian(values)) if np.isfinite(values).any() else 0.5 * (side - 1.0)
            for values, side in zip(given, size, strict=True)
        ]
        found = other_middle(middle, size)
        if found and names[0] == "cx_px":
            raise _wrong(f"{path}: cx_px, cy_px", "pixels of this video", found)
        for name in [name for name in ("cx", "cy") if name in names and name in columns]:
            values = columns.pop(name)
            if found or f"{name}_px" in columns:
                left_out.append(name)
            else:
                columns[f"{name}_px"] = values


def _focal_lengths(path: Path, columns: Mapping[str, Floats], size: tuple[int, int]) -> Floats:
    """Return focal lengths [px], also from those in millimetres, or from fields of view."""
    given = [name for name in ("focal_px", "focal_mm", "fov", "fov_y") if name in columns]
    if not given:
        return np.full(len(next(iter(columns.values()))), np.nan)
    values = columns[given[0]]
    if given == ["focal_px"]:
        return values
    if given == ["focal_mm"] and "sensor_width_mm" in columns:
        return values * size[0] / columns["sensor_width_mm"]
    if given in (["fov"], ["fov_y"]):
        return 0.5 * size[given == ["fov_y"]] / np.tan(np.radians(0.5 * values))
    expected = "one of focal_px, fov, fov_y, or focal_mm with sensor_width_mm"
    raise _wrong(str(path), expected, ", ".join(given), "Keep one of these columns.")


def apply_zoom_table(data: CameraData, path: Path, size: tuple[int, int]) -> CameraData:
    """Return camera data with the focal lengths of their zoom counts, linear between the rows.

    The table of the lens has the column zoom, and one of the focal length or field of view, which
    only rises or only falls. `size` is width and height of the image [px].
    """
    columns, _, _ = _read_columns(path, ("zoom",))
    order = np.argsort(columns["zoom"])
    zoom, focal = columns["zoom"][order], _focal_lengths(path, columns, size)[order]
    steps = np.diff([zoom, focal * np.sign(focal[-1] - focal[0])])
    if not (steps > 0.0).all() or not steps.size:
        expected = "two rows or more whose focal length only rises or only falls with zoom"
        raise _wrong(str(path), expected, f"{len(zoom)} rows of another kind")
    values = data.values.copy()
    values[:, 6] = np.interp(values[:, 9], zoom, focal, left=np.nan, right=np.nan)
    notes = [note for note in data.notes if note != COUNTS]
    if outside := int(np.isnan(values[:, 6]).sum()):
        notes.append(f"{outside} rows have zoom counts outside of the table of the lens")
    return replace(data, values=values, notes=tuple(notes))


def _frames(path: Path, number: int, text: str, fps: float) -> int:
    """Return the count of frames of a time code, which drops numbers if it has a semicolon."""
    found, base = re.fullmatch(r"(\d+):(\d\d):(\d\d)([:;.])(\d+)", text), round(fps)
    if found is None or int(found[5]) >= base:
        where = f"{path}: entry {number}: timecode"
        raise _wrong(where, f"HH:MM:SS:FF at {fps:g} frames per second", repr(text))
    minutes = 60 * int(found[1]) + int(found[2])
    dropped = (minutes - minutes // 10) * round(base / 15) if found[4] == ";" else 0
    return (60 * minutes + int(found[3])) * base + int(found[5]) - dropped


def _wrong(
    where: str, expected: str, found: str, todo: str = "Export the camera data again."
) -> InputError:
    return InputError(where, expected=expected, found=found, todo=todo)
