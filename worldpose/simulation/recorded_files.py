"""Files of recorded motion: motion capture from BVH or npz, tracking data from npz.

A motion capture archive has `joints` (frames, joints, 3), `joint_names` and `fps`; tracking data
have `xy` (samples, people, 2) [m], world axes with the centre spot as origin, NaN where a person is
absent, `time` (samples,) [s] or `fps`, and optionally `segment` (samples,), a number for each chunk
without gaps. Archives have no pickled objects.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Flags, Floats
from worldpose.errors import InputError
from worldpose.parsing import read_npz_members

_CHANNELS: Final = (
    *("Xposition", "Yposition", "Zposition"),
    *("Xrotation", "Yrotation", "Zrotation"),
)
LIMBS: Final = {
    f"{side}_{part}": (
        f"{side[0]}{short}",
        f"{side.title()}{long}",
        f"{side.title()}{part.title()}",
    )
    for part, short, long in (
        *(("shoulder", "Shldr", "Arm"), ("elbow", "ForeArm", "ForeArm"), ("wrist", "Hand", "Hand")),
        *(("hip", "Thigh", "UpLeg"), ("knee", "Shin", "Leg"), ("ankle", "Foot", "Foot")),
    )
    for side in ("left", "right")
}
"""COCO's joints 5 to 16 and their names in conversions of the CMU database; case does not matter,
the first existing name is used."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A captured motion.

    Attributes:
        names: names of the joints; the end of a terminal joint's bone is called "<joint>_end".
        positions: (frames, joints, 3), in the file's axes and unit.
        fps: frames per second [1/s].
    """

    names: tuple[str, ...]
    positions: Floats
    fps: float

    def select(self, path: Path, spellings: Mapping[str, Iterable[str]]) -> Floats:
        """Return joints (frames, points, 3) by their first known spellings, or InputError."""
        known = {name.lower(): number for number, name in enumerate(self.names)}
        found = []
        for name, options in spellings.items():
            match = next((known[each.lower()] for each in options if each.lower() in known), None)
            if match is None:
                called = f"a joint for the {name.replace('_', ' ')}, called {' or '.join(options)}"
                todo = "Rename the joints to those of conversions of the CMU database."
                raise refuse(path, called, ", ".join(self.names), todo)
            found.append(match)
        return np.asarray(self.positions[:, found])


@dataclass(frozen=True, eq=False)
class Tracking:
    """A chunk without gaps: clock (samples,) from 0 [s], and xy (samples, people, 2) [m]."""

    name: str
    clock: Floats
    xy: Floats


def refuse(
    path: Path, expected: str, found: str, todo: str = "See docs/explanation/simulation.md."
) -> InputError:
    """Return the error about a file."""
    return InputError(str(path), expected=expected, found=found, todo=todo)


def read_archive(path: Path) -> dict[str, NDArray[Any]]:
    """Return the known arrays of an npz file; InputError if it has pickled objects, or is none."""
    names = ("joints", "joint_names", "fps", "xy", "time", "segment")
    try:
        return read_npz_members(path, names)
    except (OSError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise refuse(path, "an npz file without pickled objects", str(error)) from error


def read_tracking(path: Path, content: Mapping[str, NDArray[Any]]) -> list[Tracking]:
    """Return the chunks of a tracking archive; InputError if arrays are missing or misshapen."""
    expected = "npz with xy (T, N, 2), and time (T,) or fps"
    xy, fps = content.get("xy", np.empty(0)), content.get("fps", np.array(0.0))
    if xy.ndim != 3 or xy.shape[-1] != 2 or len(xy) == 0 or xy.dtype.kind not in "fiu":
        raise refuse(path, expected, f"xy of shape {xy.shape}")
    if "time" not in content and not (fps.size == 1 and float(fps.item()) > 0.0):
        raise refuse(path, expected, "neither time nor fps")
    time = content["time"] if "time" in content else np.arange(len(xy)) / float(fps.item())
    segment = content.get("segment", np.zeros(len(xy)))
    if time.shape != (len(xy),) or segment.shape != (len(xy),):
        found = f"time {time.shape}, segment {segment.shape} for {len(xy)} rows"
        raise refuse(path, expected, found)
    time, xy = time.astype(np.float64), xy.astype(np.float64)
    edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(time) <= 0.0)) + 1
    chunks = np.split(np.arange(len(time)), edges)
    return [Tracking(path.stem, time[rows] - time[rows[0]], xy[rows]) for rows in chunks]


FACING_SPEED: Final = 0.45
"""Slower people keep their heading [m/s]."""


def follow_track(
    times: Floats, clock: Floats, xy: Floats, smoothing_s: float, scale: Floats | float = 1.0
) -> tuple[Floats, Floats]:
    """Return places (samples, 2) [m] and headings (samples,) [rad] of a tracked person.

    `times` (samples,) [s] are even; `clock` (rows,) [s] and `xy` (rows, 2) [m] are the data,
    `smoothing_s` is a standard deviation, `scale` (2,) that of this pitch to theirs.
    """
    fastest = 9.0  # [m/s]
    coast = 0.5  # time in which people come to a stop before and after the data [s]
    step = times[1] - times[0]
    place = np.stack([np.interp(times, clock, column) for column in xy.T], -1) * scale
    for part, edge in ((times < clock[0], 0), (times > clock[-1], -1)):
        if part.any():
            near = np.abs(clock - clock[edge]) <= 0.6
            speed = np.array([np.polyfit(clock[near], c[near], 1)[0] for c in xy.T]) * scale
            beyond = times[part] - clock[edge]
            coasted = -np.expm1(-np.abs(beyond)[:, None] / coast)
            place[part] += np.sign(beyond)[:, None] * coast * speed * coasted
    place = gaussian_filter1d(place, smoothing_s / step, axis=0, mode="nearest")
    velocity = np.gradient(place, step, axis=0)
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    velocity *= np.minimum(1.0, fastest / np.maximum(speed, 1e-9))
    middle = len(times) // 2
    moved = np.cumsum(velocity, axis=0) * step
    going = np.linalg.norm(velocity, axis=-1) > FACING_SPEED
    return place[middle] + moved - moved[middle], turn_along(velocity + 1e-9, going, 0.0, step)


def turn_along(aim: Floats, going: Flags, begin: float, step: float) -> Floats:
    """Return headings (samples,) [rad] along an aim (samples, 2), kept where a person is not going.

    `going` (samples,) tells whether the person turns to the aim; one who never goes has heading
    `begin` [rad]. `step` is the time between samples [s].
    """
    heading = np.full(len(aim), begin)
    if going.any():
        course = np.unwrap(np.arctan2(aim[going, 1], aim[going, 0]))
        heading = np.interp(np.arange(len(aim)), np.flatnonzero(going), course)
    return np.asarray(gaussian_filter1d(heading, 0.22 / step, mode="nearest"))


def read_capture(path: Path, content: Mapping[str, NDArray[Any]]) -> Capture:
    """Return the motion of an archive; InputError if arrays are missing or misshapen."""
    expected = "npz with joints (frames, joints, 3), joint_names (joints,) and fps above 0"
    todo = "Save such a file with numpy.savez, or pass a BVH file."
    if lacking := {"joints", "joint_names", "fps"} - content.keys():
        raise refuse(path, expected, f"no {', '.join(sorted(lacking))}", todo)
    joints, names = content["joints"], tuple(str(name) for name in content["joint_names"])
    fps = np.asarray(content["fps"])
    known = fps.size == 1 and fps.dtype.kind in "fiu" and float(fps.item()) > 0.0
    if joints.ndim != 3 or joints.shape[1:] != (len(names), 3) or not known:
        found = f"joints {joints.shape}, {len(names)} names, fps {fps}"
        raise refuse(path, expected, found, todo)
    return Capture(names, joints.astype(np.float64), float(fps.item()))


def read_bvh(path: Path) -> Capture:
    """Return the joint positions of a BVH file by forward kinematics; InputError if it is none.

    A joint's rotation is the product of its rotation channels in the file's order; position
    channels replace its offset, the convention of exporters.
    """
    reader = _Reader(path)
    reader.expect("HIERARCHY", "ROOT")
    reader.joint(-1)
    reader.expect("MOTION", "Frames:")
    frames = reader.number()
    reader.expect("Frame", "Time:")
    frame_time = reader.number()
    values = np.array([reader.number() for _ in reader.words[reader.place :]])
    width = sum(len(channels) for channels in reader.channels)
    if frames < 1 or frame_time <= 0.0 or len(values) != round(frames) * width:
        said = f"{frames:g} frames of {width} channels every {frame_time:g} s"
        raise reader.refuse(f"{said}, and {len(values)} numbers")
    rows = values.reshape(round(frames), width)
    positions = _positions(np.array(reader.offsets), reader.parents, reader.channels, rows)
    return Capture(tuple(reader.names), positions, 1.0 / frame_time)


class _Reader:
    """Tokens of a BVH file and the joints read so far."""

    def __init__(self, path: Path) -> None:
        self.path, self.place = path, 0
        try:
            self.words = path.read_text(encoding="utf-8", errors="strict").split()
        except (OSError, UnicodeDecodeError) as error:
            raise self.refuse(str(error)) from error
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...]] = []

    def refuse(self, found: str) -> InputError:
        expected = "a BVH file: HIERARCHY, MOTION, and as many numbers as frames times channels"
        todo = "Export the clip again with six or three channels per joint."
        return refuse(self.path, expected, found, todo)

    def word(self) -> str:
        if self.place >= len(self.words):
            raise self.refuse("the file ends too early")
        self.place += 1
        return self.words[self.place - 1]

    def expect(self, *words: str) -> None:
        for what in words:
            found = self.word()
            if found.upper() != what.upper():
                raise self.refuse(f"{found!r} as word {self.place} instead of {what!r}")

    def number(self) -> float:
        word = self.word()
        try:
            number = float(word)
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise self.refuse(f"{word!r} as word {self.place} instead of a number")
        return number

    def joint(self, parent: int) -> None:
        """Read a joint from its name to its closing brace, and its children."""
        index = len(self.names)
        ends = parent >= 0 and self.words[self.place - 1] == "End"
        name = self.word()
        self.names.append(f"{self.names[parent]}_end" if ends else name)
        self.parents.append(parent)
        self.expect("{", "OFFSET")
        self.offsets.append([self.number() for _ in range(3)])
        self.channels.append(())
        while (word := self.word()) != "}":
            if word.upper() == "CHANNELS" and not ends:
                channels = tuple(self.word() for _ in range(round(self.number())))
                if unknown := sorted(set(channels) - set(_CHANNELS)):
                    raise self.refuse(f"channels {', '.join(unknown)} of {name}")
                self.channels[index] = channels
            elif word in ("JOINT", "End") and not ends:
                self.joint(index)
            else:
                raise self.refuse(f"{word!r} as word {self.place} within {name}")


def _positions(
    offsets: Floats, parents: list[int], channels: list[tuple[str, ...]], rows: Floats
) -> Floats:
    """Return positions (frames, joints, 3) by forward kinematics."""
    frames, first = len(rows), 0
    positions = np.empty((frames, len(parents), 3))
    turned = np.empty((frames, len(parents), 3, 3))
    for joint, (parent, names) in enumerate(zip(parents, channels, strict=True)):
        offset = np.tile(offsets[joint], (frames, 1))
        own = np.tile(np.eye(3), (frames, 1, 1))
        for name in names:
            axis, value = "XYZ".index(name[0]), rows[:, first]
            first += 1
            if name.endswith("position"):
                offset[:, axis] = value
            else:
                own = own @ _about(axis, np.radians(value))
        if parent < 0:
            positions[:, joint], turned[:, joint] = offset, own
        else:
            parent_turn = turned[:, parent]
            positions[:, joint] = positions[:, parent] + (parent_turn @ offset[..., None])[..., 0]
            turned[:, joint] = parent_turn @ own
    return positions


def _about(axis: int, angle: Floats) -> Floats:
    """Return rotations (frames, 3, 3) about one axis [rad]."""
    rotation = np.zeros((len(angle), 3, 3))
    one, other = (axis + 1) % 3, (axis + 2) % 3
    rotation[:, axis, axis] = 1.0
    rotation[:, one, one] = rotation[:, other, other] = np.cos(angle)
    rotation[:, other, one], rotation[:, one, other] = np.sin(angle), -np.sin(angle)
    return rotation
