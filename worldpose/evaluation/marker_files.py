"""Marker-based reference: readers for C3D and TRC files, and joints from markers (X1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import yaml
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from worldpose.errors import InputError

METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of each unit in such files [m]."""
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
    points: NDArray[np.float64]
    """(samples, markers, 3) [m], the system's own world; NaN where missing."""


def read_markers(path: Path) -> Markers:
    """Return the markers of a C3D or TRC file.

    Raises:
        InputError: the file is unreadable, has no unit, or c3d is not installed.
    """
    if not path.is_file():
        raise _wrong(path, "a C3D or TRC file", "nothing")
    if path.suffix.lower() == ".c3d":
        return _read_c3d(path)
    try:
        rate, names, points, unit = _read_trc(path)
    # A truncated file lacks lines, cells or keys; text may be no number or no UTF-8.
    except (OSError, LookupError, ValueError) as error:
        raise _wrong(path, "a whole C3D or TRC file", f"{error!r}") from error
    return _checked(path, rate, names, points, unit)


def joints_of_markers(names: tuple[str, ...]) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return people and joints from marker names of the form `joint` or `person:joint`.

    Args:
        names: markers; the function skips names outside COCO-17.
    """
    people: dict[str, dict[str, tuple[str, ...]]] = {}
    for name in names:
        person, _, joint = name.rpartition(":")
        if joint.lower() in COCO17:
            people.setdefault(person or "1", {})[joint.lower()] = (name,)
    return people


def read_marker_map(path: Path) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return people and joints of a YAML file: `person: {joint: marker, joint: [marker, ...]}`.

    Raises:
        InputError: the file has another structure, or a joint is not in COCO-17.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise _wrong(path, "YAML: person: {joint: [marker, ...]}", str(error)) from None
    if not isinstance(content, dict) or not all(isinstance(p, dict) for p in content.values()):
        raise _wrong(path, "YAML: person: {joint: [marker, ...]}", f"a {type(content).__name__}")
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


def marker_joints(markers: Markers, people: People) -> NDArray[np.float64]:
    """Return joints (samples, persons, 17, 3) [m] in the system's world; NaN where missing.

    A joint is the mean of its markers, and missing if one of them is missing.

    Raises:
        InputError: there is no person, or the file lacks a marker.
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
            lacking = [name for name in names if name not in place]
            if lacking:
                raise _wrong(f"markers of {person}", f"the marker {lacking[0]}", "none")
            columns = [place[name] for name in names]
            joints[:, row, COCO17.index(joint)] = markers.points[:, columns].mean(1)
    return joints


def _read_c3d(path: Path) -> Markers:
    try:
        import c3d
    except ImportError:
        raise _wrong(path, "the package c3d, which reads it", "none installed") from None
    try:
        with path.open("rb") as file:
            reader = c3d.Reader(file)
            unit = reader.get("POINT:UNITS").string_value.strip().lower()
            names = tuple(label.strip() for label in reader.point_labels)
            # Copies: the reader reuses its array. Residual -1 means missing.
            rows = [points[:, :4].copy() for _, points, _ in reader.read_frames()]
            rate = float(reader.point_rate)
    except MemoryError:
        raise
    except Exception as error:  # c3d documents no closed list for damaged files
        raise _wrong(path, "a whole C3D or TRC file", f"{error!r}") from error
    values = np.array(rows, dtype=np.float64).reshape(len(rows), -1, 4)
    points = np.where(values[..., 3:] < 0.0, np.nan, values[..., :3])
    return _checked(path, rate, names[: points.shape[1]], points, unit)


def _read_trc(path: Path) -> tuple[float, tuple[str, ...], NDArray[np.float64], str]:
    """Return rate [1/s], names, points (samples, markers, 3) in the file's unit, and that unit."""
    lines = path.read_text(encoding="utf-8").splitlines()
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    names = tuple(name for name in lines[3].split("\t")[2:] if name)
    width = 2 + 3 * len(names)
    rows = [
        [
            float(cell) if cell.strip() else np.nan
            for cell in (line.split("\t") + [""] * width)[2:width]
        ]
        for line in lines[5:]
        if line.strip()
    ]
    points = np.array(rows, dtype=np.float64).reshape(len(rows), len(names), 3)
    return float(about["DataRate"]), names, points, about["Units"].strip().lower()


def _checked(
    path: Path, rate: float, names: tuple[str, ...], points: NDArray[np.float64], unit: str
) -> Markers:
    if unit not in METRES or not rate > 0.0 or len(names) != points.shape[1]:
        raise _wrong(
            path,
            f"markers with a rate and a unit of {', '.join(METRES)}",
            f"{rate:g} samples/s in {unit!r}, {len(names)} names of {points.shape[1]} markers",
        )
    whole = np.isfinite(points).all(-1, keepdims=True)
    return Markers(rate, names, np.where(whole, points, np.nan) * METRES[unit])


def _wrong(where: object, expected: str, found: str) -> InputError:
    return InputError(
        str(where), expected=expected, found=found, todo="Export it anew, or name another file."
    )
