"""Alignment of a marker-based reference to a prediction in time and space."""

from __future__ import annotations

import codecs
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from scipy.optimize import minimize_scalar

from data_contracts.arrays import Floats, Integers
from data_contracts.conventions import COCO17
from worldpose.errors import DegenerateError, InputError, say_failure
from worldpose.evaluation.matching import (
    joint_distances,
    match_people,
    move_people,
    register_world,
    take_matched,
)
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.rigid import Similarity, align
from worldpose.parsing import decimal_point

METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of each unit in such files [m]."""
UNIT_NAMES: Final = {
    f"{prefix}met{end}": f"{sign}m"
    for prefix, sign in (("", ""), ("centi", "c"), ("milli", "m"))
    for end in ("er", "ers", "re", "res")
}
"""Units as words."""
SUFFIXES: Final = (".c3d", ".trc")
"""Suffixes of marker files."""
People = Mapping[str, Mapping[str, tuple[str, ...]]]
"""Markers by person and joint; their mean is the joint."""


@dataclass(frozen=True, eq=False)
class Markers:
    """Marker trajectories of a motion capture system."""

    rate: float
    """Samples per second [1/s]."""
    names: tuple[str, ...]
    points: Floats
    """(samples, markers, 3) [m], the system's own world; NaN where missing."""
    zeros: int = 0
    """Number of markers at exactly 0, 0, 0, which are missing."""
    start: float = 0.0
    """Time of the first sample on the file's own clock [s]."""


def read_markers(path: Path) -> Markers:
    """Return the markers of a C3D or TRC file; InputError without a unit or c3d's library."""
    if not path.is_file():
        raise _wrong(path, "a C3D or TRC file", "nothing")
    if path.suffix.lower() == ".c3d":
        return _read_c3d(path)
    try:
        rate, names, points, unit, start = _read_trc(path)
    # A truncated file lacks lines, cells or keys; text may be no number or no UTF-8.
    except (OSError, LookupError, ValueError) as error:
        raise _wrong(path, "a complete C3D or TRC file", say_failure(error)) from error
    return replace(_check_markers(path, rate, names, points, unit), start=start)


def map_marker_names(names: tuple[str, ...]) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return people and joints from markers `joint` or `person:joint`; others are skipped."""
    people: dict[str, dict[str, tuple[str, ...]]] = {}
    for name in names:
        person, _, joint = name.rpartition(":")
        if joint.lower() in COCO17:
            people.setdefault(person or "1", {})[joint.lower()] = (name,)
    return people


def read_marker_map(path: Path) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return people and joints of a YAML file: `person: {joint: marker, joint: [marker, ...]}`."""
    expected = "YAML: person: {joint: [marker, ...]}"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise _wrong(path, expected, say_failure(error)) from None
    if not isinstance(content, dict) or not all(isinstance(p, dict) for p in content.values()):
        raise _wrong(path, expected, f"a {type(content).__name__}")
    people = {}
    for person, joints in content.items():
        unknown = [joint for joint in joints if joint not in COCO17]
        if unknown:
            raise _wrong(f"{path}: {person}", f"joints of {', '.join(COCO17)}", str(unknown[0]))
        people[str(person)] = {
            joint: tuple(map(str, marks)) if isinstance(marks, list) else (str(marks),)
            for joint, marks in joints.items()
        }
    return people


def marker_joints(markers: Markers, people: People) -> Floats:
    """Return joints (samples, persons, 17, 3) [m] in the system's world; NaN where missing.

    A joint is the mean of its markers, and missing if one of them is missing. InputError if there
    is no person, or the file lacks a marker or has it twice.
    """
    if not people:
        raise _wrong(
            "markers",
            "markers called after joints (left_hip or person:left_hip), or a map of them",
            ", ".join(markers.names[:8]),
        )
    place = {name: index for index, name in enumerate(markers.names)}
    joints = np.full((len(markers.points), len(people), len(COCO17), 3), np.nan)
    for row, (person, found) in enumerate(people.items()):
        for joint, names in found.items():
            for name in names:
                if (count := markers.names.count(name)) != 1:
                    raise _wrong(f"markers of {person}", f"the marker {name}", f"{count} of it")
            columns = [place[name] for name in names]
            joints[:, row, COCO17.index(joint)] = markers.points[:, columns].mean(1)
    return joints


def _read_c3d(path: Path) -> Markers:
    try:
        import c3d
    except ImportError:
        raise _wrong(path, "the package c3d, which reads it", "none installed") from None
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "No analog data")
            reader = c3d.Reader(file)
            given = reader.get("POINT:UNITS")
            units = () if given is None else given.string_array
            units = units if given is None or given.dimensions else (given.string_value,)
            # Some programs repeat it for each point, or leave the others blank.
            unit = ", ".join(dict.fromkeys(filter(None, map(_plain_label, units)))).lower()
            names = c3d_labels(reader)
            # Analog channels are not read; the reader fails at a single scale.
            reader.get_analog_transform = lambda: (1.0, 0.0)
            # Copies: the reader reuses its array. Residual -1 means missing.
            rows = [points[:, :4].copy() for _, points, _ in reader.read_frames()]
            rate = float(reader.point_rate)
            stated = int(reader.last_frame) - int(reader.first_frame) + 1
    except MemoryError:
        raise
    except Exception as error:  # c3d documents no closed list for damaged files
        raise _wrong(path, "a complete C3D or TRC file", say_failure(error)) from error
    if len(rows) < stated:
        found = f"{len(rows)}: it was cut off" + ", or is too long for C3D" * (stated >= 65535)
        raise _wrong(path, f"{stated} frames, as it says", found)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), -1, 4)
    points = np.where(values[..., 3:] < 0.0, np.nan, values[..., :3])
    if not unit:
        raise _wrong(f"{path}: POINT:UNITS", f"the unit of length: {', '.join(METRES)}", "none")
    return _check_markers(path, rate, names[: points.shape[1]], points, unit)


def c3d_labels(reader: Any) -> tuple[str, ...]:  # noqa: ANN401
    """Return the markers' names: LABELS, and LABELS2 and so on of files with more than 255."""
    names: list[str] = []
    number = 1
    while True:
        part = reader.get("POINT:LABELS" + (str(number) if number > 1 else ""))
        if part is None:
            return tuple(names)
        names += [_plain_label(label) for label in part.string_array]
        number += 1


def _plain_label(text: object) -> str:
    """Return a text of a C3D file without its padding, of spaces or of zero bytes."""
    return str(text).strip(" \0\t\r\n")


def _read_trc(path: Path) -> tuple[float, tuple[str, ...], Floats, str, float]:
    """Return rate [1/s], names, points (samples, markers, 3), unit and first time [s]."""
    # The first line has the path, in the bytes of the writer's system; only numbers matter.
    content = path.read_bytes()
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if is_wide else "utf-8", errors="replace")
    lines = text.splitlines()
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    title = [cell.strip() for cell in lines[3].rstrip().split("\t")[2:]]
    # A name stands above its x; a marker without a name has three columns as well.
    is_spread = not any(name for place, name in enumerate(title) if place % 3)
    names = tuple(title[::3]) if is_spread else tuple(filter(None, title))
    width = 2 + 3 * len(names)
    cells = [(line.split("\t") + [""] * width)[:width] for line in lines[5:] if line.strip()]
    *_, before, last = (0, 0, *(line.count("\t") + 1 for line in lines[5:]))
    if 0 < last < before and not text.endswith(("\n", "\r")):
        raise _wrong(path, f"{before} columns in the last row", f"{last}: it was cut off")
    # Commas beside points are of thousands, and refused.
    has_points = any("." in cell for row in cells for cell in row)
    number = str if has_points else decimal_point
    rows = [[float(number(cell.strip()) or "nan") for cell in row] for row in cells]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), width)
    rate = float(number(about["DataRate"]))
    place = _samples(path, table[:, 0], rate * table[:, 1])
    points = np.full((place[-1] + 1 if len(place) else 0, len(names), 3), np.nan)
    points[place] = table[:, 2:].reshape(len(rows), len(names), 3)
    start = float(table[0, 1]) if len(table) and np.isfinite(table[0, 1]) else 0.0
    return rate, names, points, about["Units"].strip().lower(), start


def _samples(path: Path, number: Floats, time: Floats) -> Integers:
    """Return the sample of each row, from 0, by its Frame# (rows,), or else its time [samples].

    InputError if neither rises, or rows are missing for longer than any recording.
    """
    most = 10_000_000
    for each in (number, time):
        steps = np.rint(np.diff(each))
        if np.isfinite(each).all() and (steps > 0).all() and steps.sum() < most:
            step = np.gcd.reduce(steps.astype(np.int64)) if each is number and len(steps) else 1
            return np.rint((each - each[:1]) / step).astype(np.int64)
    found = f"{number[:3].tolist()} and so on in {len(number)} rows"
    raise _wrong(f"{path}: Frame#", "numbers, or else times, that rise", found)


def _check_markers(
    path: Path, rate: float, names: tuple[str, ...], points: Floats, unit: str
) -> Markers:
    unit = UNIT_NAMES.get(unit, unit)
    if len(points) == 0:
        raise _wrong(path, "samples of markers", "none")
    if unit not in METRES or not rate > 0.0 or len(names) != points.shape[1]:
        raise _wrong(
            path,
            f"markers with a rate and a unit of {', '.join(METRES)}",
            f"{rate:g} samples/s in {unit!r}, {len(names)} names of {points.shape[1]} markers",
        )
    zero = (points == 0.0).all(-1, keepdims=True)
    whole = np.isfinite(points).all(-1, keepdims=True) & ~zero
    places = np.where(whole, points, np.nan) * METRES[unit]
    return Markers(rate, names, places, int(zero.sum()))


def _wrong(where: object, expected: str, found: str) -> InputError:
    return InputError(
        str(where), expected=expected, found=found, todo="Export it again, or name another file."
    )


@dataclass(frozen=True, eq=False)
class ReferenceAlignment:
    """Clock offset and motion that align a reference to a prediction."""

    offset: float
    """Time on the reference's clock at match frame 0 [s]."""
    motion: Similarity
    """Motion from the reference's world into the prediction's; its scale is 1."""
    residual: float
    """Root mean square distance of joints after the motion [m]."""
    elsewhere: float
    """The least of it at offsets that are 0.4 to 2 s away [m]; infinite if unknown."""

    @property
    def is_sure(self) -> bool:
        """Whether people moved enough, in enough frames, to tell the offset from others."""
        return bool(np.isfinite(self.elsewhere)) and self.elsewhere > 1.5 * self.residual


def align_reference(
    prediction: JointTracks, joints: Floats, rate: float, fps: float, start: float = 0.0
) -> tuple[JointTracks, ReferenceAlignment]:
    """Return the reference in the prediction's frames and world, and its alignment.

    The clock offset minimizes the distance: a grid search with a new registration of people at each
    offset, then a refinement with fixed matches. The motion is rigid: a wrong size of the
    prediction remains an error. DegenerateError if they match at no offset.

    `joints` (samples, persons, 17, 3) [m] are in the reference's world, NaN where missing, at
    `rate` samples per second [1/s], the first one at `start` [s] of the clock. The clock of a part
    of a recording may also count from its first sample, and that of a file from the prediction's
    first frame, as `write_c3d` does.
    """
    # Step of the initial grid over clock offsets [s]: a walk of 30 cm, within the gate.
    step_s = 0.2
    max_offset_s = 2.0  # maximum clock offset of the search, either way [s]
    times = prediction.frames / fps - start  # since the first sample, if both clocks agree
    count = int(np.ceil(max_offset_s / step_s))
    middles = np.array([0.0, start, -times[0] if len(times) else 0.0])
    grid = np.unique(middles[:, None] + np.arange(-count, count + 1) * step_s)
    tried = [
        (_match_cost(prediction.joints, sample_joints(joints, rate, times + o)), o) for o in grid
    ]
    best, offset = min(tried, key=lambda pair: pair[0][0])
    _, match = best
    if match is None:
        raise DegenerateError(
            "the reference matches the prediction nowhere within "
            f"{max_offset_s:g} s of difference between their clocks"
        )

    def error(shift: float, fewest: int = 0) -> float:
        moved = sample_joints(joints, rate, times + shift)
        if np.isfinite(moved[..., 0]).sum() < fewest:
            return np.inf
        return _fit_motion(prediction.joints, moved, match)[1]

    # Tenths of a millisecond: a millimetre of a runner's path.
    found = minimize_scalar(
        error, bounds=(offset - step_s, offset + step_s), method="bounded", options={"xatol": 1e-4}
    )
    moved = sample_joints(joints, rate, times + found.x)
    motion, residual = _fit_motion(prediction.joints, moved, match)
    placed = motion.apply(moved.reshape(-1, 3)).reshape(moved.shape)
    ids = np.arange(1, moved.shape[1] + 1)
    tracks = JointTracks(prediction.frames, ids, placed)
    away = np.arange(4, 2 * count + 1) * step_s / 2
    # A short overlap fits by chance.
    fewest = int(np.isfinite(moved[..., 0]).sum()) // 2
    elsewhere = min(error(found.x + shift, fewest) for shift in (*-away, *away))
    return tracks, ReferenceAlignment(float(found.x), motion, residual, elsewhere)


def sample_joints(joints: Floats, rate: float, times: Floats) -> Floats:
    """Return joints (times, persons, 17, 3) at times on their own clock, interpolated linearly.

    Joints are (samples, persons, 17, 3) [m] at a rate [1/s], times (times,) [s] since the first
    sample. NaN outside the samples, and if either neighbour is missing.
    """
    place = np.round(times * rate, 9)
    before = np.floor(place).astype(np.int64)
    share = (place - before)[:, None, None, None]
    last = len(joints) - 1
    inside = (place >= 0.0) & (place <= last)
    low, high = np.clip(before, 0, last), np.clip(before + 1, 0, last)
    # Exactly on a sample, ignore the next one, which may be missing.
    between = (1.0 - share) * joints[low] + np.where(share > 0.0, share * joints[high], 0.0)
    return np.where(inside[:, None, None, None], between, np.nan)


def _match_cost(people: Floats, reference: Floats) -> tuple[float, Integers | None]:
    """Return the sum of joint distances, clipped at the gate, and the match after registration."""
    # Maximum mean joint distance of matched persons after alignment [m], as in the
    # evaluation.
    match_gate_m = 1.0
    motion = register_world(reference, people, match_gate_m)
    if motion is None:
        return np.inf, None
    distances = joint_distances(people, move_people(motion, reference))
    match = match_people(distances, match_gate_m)
    there = int(np.isfinite(reference[..., 0]).any(-1).sum())
    if not (match >= 0).any():
        return np.inf, None
    chosen = np.take_along_axis(distances, np.maximum(match, 0)[..., None], axis=2)[..., 0]
    total = np.where(match >= 0, chosen, 0.0).sum() + match_gate_m * (there - (match >= 0).sum())
    # Missing people cost the gate, so that a short overlap that fits by chance does not win.
    missing = match_gate_m * (len(reference) * reference.shape[1] - there)
    return float(total + missing), match


def _fit_motion(people: Floats, reference: Floats, match: Integers) -> tuple[Similarity, float]:
    """Return the rigid motion of the reference onto matched people, and the rms residual [m]."""
    target = take_matched(people, match).reshape(-1, 3)
    motion = align(reference.reshape(-1, 3), target, with_scale=False)
    squares = np.square(motion.apply(reference.reshape(-1, 3)) - target).sum(-1)
    known = np.isfinite(squares)
    return motion, float(np.sqrt(squares[known].mean())) if known.any() else np.inf
