"""BVH motion capture: a skeleton's joint positions over time, from a text file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.errors import InputError

_CHANNELS: Final = (
    *("Xposition", "Yposition", "Zposition"),
    *("Xrotation", "Yrotation", "Zrotation"),
)


@dataclass(frozen=True, eq=False)
class Capture:
    """A captured motion.

    Attributes:
        names: of the joints; the end of a terminal joint's bone is called "<joint>_end".
        parents: (joints,) index of each joint's parent, -1 for the root; parents come first.
        positions: (frames, joints, 3), in the file's axes and unit.
        frame_time: [s].
    """

    names: tuple[str, ...]
    parents: NDArray[np.int64]
    positions: Floats
    frame_time: float


@dataclass(frozen=True, eq=False)
class Clip:
    """A person's captured motion.

    Attributes:
        time: (frames,) [s], from 0.
        points: (frames, 13, 3) [m], z up, above the ground, in the order of
            `worldpose.simulation.recordings.NAMES`.
    """

    time: Floats
    points: Floats


def read_bvh(path: Path) -> Capture:
    """Return the joint positions of a BVH file by forward kinematics.

    A joint's rotation is the product of its rotation channels in the file's order; position
    channels replace its offset, the convention of exporters.

    Args:
        path: text with a HIERARCHY and a MOTION part.

    Raises:
        InputError: not a BVH file, unknown channels, or rows of a wrong length.
    """
    try:
        words = path.read_text(encoding="utf-8", errors="strict").split()
    except (OSError, UnicodeDecodeError) as error:
        raise _unusable(path, str(error)) from error
    reader = _Reader(path, words)
    reader.expect("HIERARCHY")
    reader.expect("ROOT")
    reader.joint(-1)
    reader.expect("MOTION")
    reader.expect("Frames:")
    frames = reader.number()
    reader.expect("Frame")
    reader.expect("Time:")
    frame_time = reader.number()
    values = reader.rest()
    width = sum(len(channels) for channels in reader.channels)
    if frames < 1 or frame_time <= 0.0 or len(values) != round(frames) * width:
        raise _unusable(
            path,
            f"{frames:g} frames of {width} channels every {frame_time:g} s, and {len(values)} "
            "numbers",
        )
    rows = values.reshape(round(frames), width)
    parents = np.array(reader.parents)
    positions = _positions(np.array(reader.offsets), parents, reader.channels, rows)
    return Capture(tuple(reader.names), parents, positions, frame_time)


class _Reader:
    """Tokens of a BVH file and the joints read so far."""

    def __init__(self, path: Path, words: list[str]) -> None:
        self.path, self.words, self.place = path, words, 0
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...]] = []

    def word(self) -> str:
        if self.place >= len(self.words):
            raise _unusable(self.path, "the file ends too early")
        self.place += 1
        return self.words[self.place - 1]

    def expect(self, what: str) -> None:
        found = self.word()
        if found.upper() != what.upper():
            raise _unusable(self.path, f"{found!r} as word {self.place} instead of {what!r}")

    def number(self) -> float:
        word = self.word()
        try:
            number = float(word)
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise _unusable(self.path, f"{word!r} as word {self.place} instead of a number")
        return number

    def rest(self) -> Floats:
        return np.array([self.number() for _ in range(len(self.words) - self.place)])

    def joint(self, parent: int) -> None:
        """Read a joint from its name to its closing brace, and its children."""
        index = len(self.names)
        ends = parent >= 0 and self.words[self.place - 1] == "End"
        name = self.word()
        self.names.append(f"{self.names[parent]}_end" if ends else name)
        self.parents.append(parent)
        self.expect("{")
        self.expect("OFFSET")
        self.offsets.append([self.number() for _ in range(3)])
        self.channels.append(())
        while (word := self.word()) != "}":
            if word.upper() == "CHANNELS" and not ends:
                channels = tuple(self.word() for _ in range(round(self.number())))
                if unknown := sorted(set(channels) - set(_CHANNELS)):
                    raise _unusable(self.path, f"channels {', '.join(unknown)} of {name}")
                self.channels[index] = channels
            elif word in ("JOINT", "End") and not ends:
                self.joint(index)
            else:
                raise _unusable(self.path, f"{word!r} as word {self.place} within {name}")


def _positions(
    offsets: Floats, parents: NDArray[np.int64], channels: list[tuple[str, ...]], rows: Floats
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


def _unusable(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="a BVH file: HIERARCHY, MOTION, and as many numbers as frames times channels",
        found=found,
        todo="Export the clip again with six or three channels per joint.",
    )
