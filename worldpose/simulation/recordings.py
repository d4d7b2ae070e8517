"""Recordings that people replay: tracking data as paths, motion capture as poses.

Motion capture comes from a BVH text file, by forward kinematics, or from an npz archive.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.errors import InputError
from worldpose.parsing import read_npz_members
from worldpose.simulation.paths import MARGIN, STEP, Clip, GroundPath
from worldpose.simulation.skeletons import Body, unit

_CHANNELS: Final = (
    *("Xposition", "Yposition", "Zposition"),
    *("Xrotation", "Yrotation", "Zrotation"),
)


@dataclass(frozen=True, eq=False)
class Capture:
    """A captured motion.

    Attributes:
        names: names of the joints; the end of a terminal joint's bone is called "<joint>_end".
        parents: (joints,) index of each joint's parent, -1 for the root; parents come first.
        positions: (frames, joints, 3), in the file's axes and unit.
        frame_time: [s].
    """

    names: tuple[str, ...]
    parents: NDArray[np.int64]
    positions: Floats
    frame_time: float


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


SMOOTHING: Final = 0.15
"""Standard deviation of the smoothing in time [s]: tracking jitters by decimetres between samples,
a runner's path does not."""
COAST: Final = 0.7
"""Time in which people come to a stop before and after the data [s]."""
FACING_SPEED: Final = 0.6
"""Slower people keep their heading [m/s]."""


def read_trajectories(
    path: Path, duration: float, *, max_people: int | None = None
) -> tuple[list[GroundPath], float]:
    """Return paths of the people in a tracking file, and their duration [s].

    The file is an npz without pickled objects: `xy` (T, N, 2) [m], world axes with the centre
    spot as origin, NaN where a person is absent; `time` (T,) [s] or `fps`; optionally `segment`
    (T,), a number for each chunk without gaps. The longest chunk is used, with the people who are
    present in all of it.

    Args:
        path: the file.
        duration: maximum duration of the clip [s], from the chunk's beginning.
        max_people: maximum number of people, in file order.

    Raises:
        InputError: unreadable, wrong shapes, or no person present for 0.2 s.
    """
    xy, time, segment = _read_tracking_archive(path)
    edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(time) <= 0.0)) + 1
    stretches = np.split(np.arange(len(time)), edges)
    rows = max(stretches, key=len)
    rows = rows[time[rows] <= time[rows[0]] + duration + 1e-9]
    there = np.isfinite(xy[rows]).all(axis=(0, 2))
    length = float(time[rows[-1]] - time[rows[0]])
    if len(rows) < 4 or length < 0.2 or not there.any():
        raise InputError(
            str(path),
            expected="0.2 s and 4 samples or more without gaps, with a person in all of them",
            found=f"{len(rows)} samples, {length:.2f} s, {int(there.sum())} people",
            todo="Pass tracking data with a longer part without gaps.",
        )
    people = np.flatnonzero(there)[:max_people]
    clock = time[rows] - time[rows[0]]
    return [_smooth_path(clock, xy[rows, person]) for person in people], length


def _read_tracking_archive(path: Path) -> tuple[Floats, Floats, Floats]:
    try:
        content = read_npz_members(path, _MEMBERS)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise _unusable_tracking(path, f"{error}") from error
    xy = content.get("xy", np.empty(0))
    if xy.ndim != 3 or xy.shape[-1] != 2 or len(xy) == 0 or xy.dtype.kind not in "fiu":
        raise _unusable_tracking(path, f"xy of shape {xy.shape}")
    fps = content.get("fps", np.array(0.0))
    if "time" not in content and not (fps.size == 1 and float(fps.item()) > 0.0):
        raise _unusable_tracking(path, "neither time nor fps")
    time = content["time"] if "time" in content else np.arange(len(xy)) / float(fps.item())
    segment = content.get("segment", np.zeros(len(xy)))
    if time.shape != (len(xy),) or segment.shape != (len(xy),):
        raise _unusable_tracking(
            path, f"time {time.shape}, segment {segment.shape} for {len(xy)} rows"
        )
    return xy.astype(np.float64), time.astype(np.float64), segment.astype(np.float64)


_MEMBERS: Final = ("xy", "time", "fps", "segment")


def _unusable_tracking(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="npz with xy (T, N, 2), and time (T,) or fps",
        found=found,
        todo="Write the file in the layout that docs/explanation/simulation.md describes.",
    )


def _smooth_path(clock: Floats, xy: Floats) -> GroundPath:
    samples = round((clock[-1] + 2.0 * MARGIN) / STEP) + 1
    time = np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)
    spline = CubicSpline(clock, xy)
    within = np.clip(time, 0.0, clock[-1])
    # A straight line fitted to the ends is steadier than the last two samples.
    first, last = (_velocity(clock, xy, at) for at in (0, -1))
    beyond = time - within
    coasted = COAST * np.sign(beyond) * (1.0 - np.exp(-np.abs(beyond) / COAST))
    place = spline(within) + coasted[:, None] * np.where(beyond[:, None] < 0.0, first, last)
    place = gaussian_filter1d(place, SMOOTHING / STEP, axis=0, mode="nearest")
    velocity = np.gradient(place, STEP, axis=0)
    speed = np.linalg.norm(velocity, axis=-1)
    moving = np.flatnonzero(speed > FACING_SPEED)
    heading = np.zeros(samples)
    if len(moving):
        course = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
        heading = np.interp(np.arange(samples), moving, course)
    heading = gaussian_filter1d(heading, SMOOTHING / STEP, mode="nearest")
    return GroundPath(time, place, heading, speed)


def _velocity(clock: Floats, xy: Floats, end: int) -> Floats:
    """Return the velocity (2,) [m/s] over the half second at one end."""
    near = np.abs(clock - clock[end]) <= max(0.5, clock[3] - clock[0])
    slope: Floats = np.polyfit(clock[near], xy[near], 1)[0]
    return slope


NAMES: Final = {
    "left shoulder": ("lShldr", "LeftArm", "LeftShoulder"),
    "right shoulder": ("rShldr", "RightArm", "RightShoulder"),
    "left elbow": ("lForeArm", "LeftForeArm", "LeftElbow"),
    "right elbow": ("rForeArm", "RightForeArm", "RightElbow"),
    "left wrist": ("lHand", "LeftHand", "LeftWrist"),
    "right wrist": ("rHand", "RightHand", "RightWrist"),
    "left hip": ("lThigh", "LeftUpLeg", "LeftHip"),
    "right hip": ("rThigh", "RightUpLeg", "RightHip"),
    "left knee": ("lShin", "LeftLeg", "LeftKnee"),
    "right knee": ("rShin", "RightLeg", "RightKnee"),
    "left ankle": ("lFoot", "LeftFoot", "LeftAnkle"),
    "right ankle": ("rFoot", "RightFoot", "RightAnkle"),
    "head": ("head_end", "head"),
}
"""Points of a clip by their names in conversions of the CMU database; case does not matter, the
first existing name is used. The first twelve are COCO's joints 5 to 16."""
USUAL_LEG: Final = 0.82
"""Length of thigh and shank together, which identifies the unit of a file [m]."""
UNITS: Final = (1.0, 0.01, 0.0254, 0.001, 0.056444)
"""Units of files [m]; the last is that of the CMU database."""
ANKLE: Final = 0.08
"""Height of the ankles above the floor in their lowest frames [m]."""
EASE: Final = 0.5
"""Time at the end of a clip in which it blends into standing [s]."""

_BONES: Final = ((6, 5), (12, 11), (5, 7), (7, 9), (6, 8), (8, 10), (11, 13), (13, 15), (12, 14))
"""Pairs of joints: shoulders and hips from right to left, limbs outward ..."""
_LAST: Final = (14, 16)


def read_clip(path: Path) -> Clip:
    """Return a file's motion in metres with z up, from the origin and facing along x.

    Up is the axis along which shoulders are above hips, y or z; the unit is the one with plausible
    leg lengths; the floor is at the lowest ankles.

    Args:
        path: a BVH file, or an npz with `joints` (frames, joints, 3), `joint_names` and `fps`.

    Raises:
        InputError: unreadable, or joints are missing.
    """
    capture = _read_capture_archive(path) if path.suffix == ".npz" else read_bvh(path)
    points = _select_points(path, capture)
    rise = (points[:, 0:2].mean(axis=1) - points[:, 6:8].mean(axis=1)).mean(axis=0)
    if np.argmax(np.abs(rise)) == 1:
        points = points[..., [2, 0, 1]]
    length = _leg_length(points)
    points = points * min(UNITS, key=lambda metres: abs(np.log(length * metres / USUAL_LEG)))
    across = points[0, 6] - points[0, 7]
    points = points @ _about_z(np.arctan2(-across[0], across[1]))
    start = points[0, 6:8].mean(axis=0)
    start[2] = np.percentile(points[:, 10:12, 2].min(axis=1), 2.0) - ANKLE
    time = np.arange(len(points), dtype=np.float64) * capture.frame_time
    return Clip(time, np.asarray(points - start, dtype=np.float64))


def clip_path(clip: Clip, like: GroundPath, body: Body) -> GroundPath:
    """Return the path of a person who plays a clip from time 0 on, and then stands.

    Args:
        clip: clip as read.
        like: place of the person at time 0, and times of the path.
        body: target of the clip's leg length.
    """
    x, y, heading = (
        float(np.interp(0.0, like.time, axis)) for axis in (*like.position.T, like.heading)
    )
    points = clip.points * (body.leg / _leg_length(clip.points)) @ _about_z(-heading) + [x, y, 0.0]
    inside = np.clip(like.time, 0.0, clip.time[-1])
    hips = points[:, 6:8].mean(axis=1)
    way = np.stack([np.interp(inside, clip.time, axis) for axis in hips[:, :2].T], axis=-1)
    way = gaussian_filter1d(way, 0.05 / STEP, axis=0, mode="nearest")
    across = points[:, 6] - points[:, 7]
    course = np.unwrap(np.arctan2(-across[:, 0], across[:, 1]))
    course += 2.0 * np.pi * np.round((heading - course[0]) / (2.0 * np.pi))
    speed = np.linalg.norm(np.gradient(way, STEP, axis=0), axis=-1)
    faces = np.interp(inside, clip.time, course)
    return GroundPath(like.time, way, faces, speed, clip=Clip(clip.time, points))


def play_clip(
    body: Body,
    clip: Clip,
    times: Floats,
    ground: Callable[[Floats, Floats], Floats],
    gait: Floats,
) -> Floats:
    """Return joints (frames, 17, 3) [m], world: the clip's bone directions with the body's lengths.

    Args:
        body: measures.
        clip: clip in its place.
        times: (frames,) [s].
        ground: height of the ground [m] at x and y [m].
        gait: (frames, 17, 3) joints of a person on the clip's path, used before and after it.
    """
    inside = np.clip(times, 0.0, clip.time[-1])
    flat = clip.points.reshape(len(clip.time), -1)
    points = np.stack([np.interp(inside, clip.time, each) for each in flat.T], axis=-1)
    points = points.reshape(len(times), -1, 3)
    played = np.concatenate([np.zeros((len(times), 5, 3)), points[:, :12]], axis=1)
    played[:, 5:, 2] += ground(*played[:, 11:13, :2].mean(axis=1).T)[:, None]
    done = np.clip(np.minimum(times, clip.time[-1] - times) / EASE, 0.0, 1.0)
    share = np.where(times < 0.5 * clip.time[-1], times >= 0.0, done**2 * (3.0 - 2.0 * done))
    share = share[:, None]

    def between(own: Floats, walked: Floats) -> Floats:
        weight = share.reshape(-1, *(1 for _ in own.shape[1:]))
        return weight * own + (1.0 - weight) * walked

    pairs = np.array([*_BONES, _LAST])
    own, walked = (unit(each[:, pairs[:, 1]] - each[:, pairs[:, 0]]) for each in (played, gait))
    bones = unit(between(own, walked))
    shoulders, walked_shoulders = played[:, 5:7].mean(axis=1), gait[:, 5:7].mean(axis=1)
    hips, walked_hips = played[:, 11:13].mean(axis=1), gait[:, 11:13].mean(axis=1)
    trunk = unit(between(unit(shoulders - hips), unit(walked_shoulders - walked_hips)))
    pelvis = between(hips, walked_hips)
    neck = pelvis + body.trunk * trunk

    joints = np.empty((len(times), 17, 3))
    for side, sign in enumerate((1.0, -1.0)):
        joints[:, 5 + side] = neck + sign * body.shoulder_half_width * bones[:, 0]
        joints[:, 11 + side] = pelvis + sign * body.hip_half_width * bones[:, 1]
    lengths = (*(body.upper_arm, body.forearm) * 2, *(body.thigh, body.shank) * 2)
    for (near, far), bone, length in zip(pairs[2:], range(2, 10), lengths, strict=True):
        joints[:, far] = joints[:, near] + length * bones[:, bone]
    # A clip's face looks square to the shoulders, upright along the line from them to the head.
    upright = np.broadcast_to([0.0, 0.0, 1.0], neck.shape)
    up = unit(between(unit(points[:, 12] - points[:, 0:2].mean(axis=1)), upright))
    left = between(own[:, 0], unit(gait[:, 3] - gait[:, 4]))
    left = unit(left - (left * up).sum(-1, keepdims=True) * up)
    head = np.stack([np.cross(left, up), left, up], axis=-2)
    joints[:, :5] = neck[:, None] + body.head @ head
    return joints


def _about_z(angle: float) -> Floats:
    """Return the matrix that turns rows of points by minus the angle [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _leg_length(points: Floats) -> float:
    """Return the length of the left leg in the first frame."""
    thigh, shank = points[0, 8] - points[0, 6], points[0, 10] - points[0, 8]
    return float(np.linalg.norm(thigh) + np.linalg.norm(shank))


def _select_points(path: Path, capture: Capture) -> Floats:
    """Return the clip's points (frames, 13, 3) in the order of `NAMES`."""
    known = {name.lower(): number for number, name in enumerate(capture.names)}
    found = []
    for name, spellings in NAMES.items():
        match = next((known[each.lower()] for each in spellings if each.lower() in known), None)
        if match is None:
            raise InputError(
                str(path),
                expected=f"a joint for the {name}, called {' or '.join(spellings)}",
                found=", ".join(capture.names),
                todo="Rename the joints to those of conversions of the CMU database.",
            )
        found.append(match)
    points: Floats = capture.positions[:, found]
    length = _leg_length(points) if len(points) else 0.0
    if len(points) < 2 or length == 0.0:
        raise InputError(
            str(path),
            expected="two frames or more of a person whose legs have a length above 0",
            found=f"{len(points)} frames, legs of length {length:g}",
            todo="Export the clip again, with all frames and the leg joints.",
        )
    return points


def _read_capture_archive(path: Path) -> Capture:
    try:
        file = read_npz_members(path, ("joints", "fps", "joint_names"))
        joints, fps = np.asarray(file["joints"], dtype=np.float64), float(file["fps"].item())
        names = tuple(str(name) for name in file["joint_names"])
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path),
            expected="npz with joints (frames, joints, 3), joint_names (joints,) and fps",
            found=f"{error}",
            todo="Save such a file with numpy.savez, or pass a BVH file.",
        ) from error
    if joints.ndim != 3 or joints.shape[1:] != (len(names), 3) or not fps > 0.0:
        raise InputError(
            str(path),
            expected="joints (frames, joints, 3) of as many names, and fps above 0",
            found=f"joints {joints.shape}, {len(names)} names, fps {fps:g}",
            todo="Save such a file with numpy.savez, or pass a BVH file.",
        )
    return Capture(names, np.full(len(names), -1), joints, 1.0 / fps)
