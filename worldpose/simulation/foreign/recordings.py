"""Recordings to replay: motion capture and tracking data, from a folder of npz files.

A motion capture file has `joints` (frames, joints, 3) [m], z up, `joint_names` and `fps`; tracking
data have `xy` (frames, players, 2) [m], `time` or `fps`, and optionally `segment`. Other files are
ignored.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.errors import InputError
from worldpose.parsing import read_npz_members
from worldpose.simulation.foreign.skeletons import Posture, Skeleton
from worldpose.simulation.foreign.trajectories import LEAD, Trajectory

JOINTS: Final = {
    **{"neck": ("neck",), "chest": ("chest",), "head": ("head",)},
    **{f"{side}_shoulder": (f"{side[0]}Shldr", f"{side.title()}Arm") for side in ("left", "right")},
    **{
        f"{side}_elbow": (f"{side[0]}ForeArm", f"{side.title()}ForeArm")
        for side in ("left", "right")
    },
    **{f"{side}_wrist": (f"{side[0]}Hand", f"{side.title()}Hand") for side in ("left", "right")},
    **{f"{side}_hip": (f"{side[0]}Thigh", f"{side.title()}UpLeg") for side in ("left", "right")},
    **{f"{side}_knee": (f"{side[0]}Shin", f"{side.title()}Leg") for side in ("left", "right")},
    **{f"{side}_ankle": (f"{side[0]}Foot", f"{side.title()}Foot") for side in ("left", "right")},
}
"""Names of a skeleton's joints in conversions of the CMU database, by the names used here."""
PLANTED: Final = (0.55, 0.06)
"""An ankle slower than this [m/s] and at most this far above its lowest place [m] is planted."""
TEMPO: Final = (0.8, 1.15)
"""Playback speed relative to the recording [1]."""
_JUMP: Final = 15.0
"""A joint this fast at the beginning [m/s] comes from a calibration pose, which is dropped."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A recorded motion.

    Attributes:
        name: name of the file.
        fps: frame rate [1/s].
        joints: joints (frames, 3) [m] by the names of `JOINTS`, z up.
    """

    name: str
    fps: float
    joints: dict[str, Floats]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.joints["neck"])


@dataclass(frozen=True, eq=False)
class Tracking:
    """A chunk of tracking data without gaps.

    Attributes:
        name: name of the file.
        clock: (rows,) [s], from 0.
        xy: (rows, players, 2) [m].
        players: their numbers in the file.
    """

    name: str
    clock: Floats
    xy: Floats
    players: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Recordings:
    """Contents of a folder of recordings."""

    motions: tuple[Motion, ...] = ()
    tracks: tuple[Tracking, ...] = ()


def read_recordings(folder: Path) -> Recordings:
    """Return the motions and tracking data in a folder and the folders in it, by file name.

    Raises:
        InputError: there is no such folder, a file cannot be read, or none has recordings.
    """
    if not folder.is_dir():
        raise InputError(
            str(folder),
            expected="a folder with npz files of motion capture or tracking data",
            found="no folder",
            todo="Pass an existing folder, or omit --recordings.",
        )
    motions: list[Motion] = []
    tracks: list[Tracking] = []
    for path in sorted(folder.rglob("*.npz")):
        content = _read(path)
        if {"joints", "joint_names", "fps"} <= content.keys():
            motions.append(_motion(path, content))
        elif "xy" in content and content["xy"].ndim == 3:
            tracks += _read_tracking(path, content)
    if not motions and not tracks:
        raise InputError(
            str(folder),
            expected="npz files with joints, joint_names and fps, or with xy and time or fps",
            found="none",
            todo="See docs/explanation/simulation.md for the layouts.",
        )
    return Recordings(tuple(motions), tuple(tracks))


def _read(path: Path) -> dict[str, NDArray[np.generic]]:
    names = ("joints", "joint_names", "fps", "xy", "time", "segment")
    try:
        return read_npz_members(path, names)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path),
            expected="an npz file without pickled objects",
            found=str(error),
            todo="Save the arrays with numpy.savez, or take the file out of the folder.",
        ) from error


def _motion(path: Path, content: dict[str, NDArray[np.generic]]) -> Motion:
    names = [str(name) for name in content["joint_names"]]
    joints = np.asarray(content["joints"], dtype=np.float64)
    fps = float(np.asarray(content["fps"], dtype=np.float64))
    found = {
        name: next((names.index(one) for one in options if one in names), -1)
        for name, options in JOINTS.items()
    }
    lacking = [name for name, index in found.items() if index < 0]
    if lacking or joints.shape[1:] != (len(names), 3) or len(joints) < 10 or not fps > 0.0:
        raise InputError(
            str(path),
            expected="joints (frames from 10, joints, 3), names of the CMU database, fps above 0",
            found=f"joints {joints.shape}, fps {fps:g}, missing: {', '.join(lacking) or 'none'}",
            todo="Rename the joints, or take the file out of the folder.",
        )
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(axis=1) * fps
    early = np.flatnonzero(speed[: len(speed) // 4] > _JUMP)
    joints = joints[early[-1] + 2 :] if len(early) else joints
    return Motion(path.stem, fps, {name: joints[:, index] for name, index in found.items()})


def _read_tracking(path: Path, content: dict[str, NDArray[np.generic]]) -> list[Tracking]:
    xy = np.asarray(content["xy"], dtype=np.float64)
    if "time" in content:
        clock = np.asarray(content["time"], dtype=np.float64)
    elif "fps" in content:
        clock = np.arange(len(xy)) / float(np.asarray(content["fps"], dtype=np.float64))
    else:
        clock = np.empty(0)
    segment = np.asarray(content.get("segment", np.zeros(len(xy))), dtype=np.float64)
    if xy.shape[-1] != 2 or clock.shape != (len(xy),) or segment.shape != (len(xy),):
        raise InputError(
            str(path),
            expected="xy (frames, players, 2), and time (frames,) or fps",
            found=f"xy {xy.shape}, time {clock.shape}, segment {segment.shape}",
            todo="Correct the file, or take it out of the folder.",
        )
    edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(clock) <= 0.0)) + 1
    found = []
    for rows in np.split(np.arange(len(xy)), edges):
        there = np.isfinite(xy[rows]).all(axis=(0, 2))
        if len(rows) > 3 and there.any():
            found.append(
                Tracking(
                    path.stem,
                    clock[rows] - clock[rows[0]],
                    xy[rows][:, there],
                    np.flatnonzero(there),
                )
            )
    return found


def play_motion(
    motion: Motion,
    skeleton: Skeleton,
    times: Floats,
    place: Floats,
    rng: np.random.Generator,
) -> tuple[Trajectory, Posture]:
    """Return the trajectory and posture of a person who replays a motion.

    Bone directions are those of the recording; the length of the legs scales trajectory and height.
    Part, direction, tempo and left-right mirroring are random; at the ends of the recording the
    playback reverses.

    Args:
        motion: the recording.
        skeleton: the person's bones.
        times: (frames,) [s], evenly spaced; the clip begins at 0.
        place: (2,) position of the person in the middle of `times` [m].
        rng: draws part, direction, tempo and side.
    """
    tempo, mirrored = float(rng.uniform(TEMPO[0], TEMPO[1])), bool(rng.random() < 0.5)
    length = (motion.frames - 1) / motion.fps
    needed = (times[-1] - times[0] - 2.0 * LEAD) * tempo
    begin = float(rng.uniform(0.0, max(length - needed, 0.0)))
    moment = begin + tempo * times
    moment = np.abs((moment + length) % (2.0 * length) - length)
    clock = np.arange(motion.frames) / motion.fps
    # Remove the capture's jitter.
    smooth = {
        name: gaussian_filter1d(joints, 0.02 * motion.fps, axis=0, mode="nearest")
        for name, joints in motion.joints.items()
    }
    at = {name: make_interp_spline(clock, joints)(moment) for name, joints in smooth.items()}
    if mirrored:
        flip = np.array([1.0, -1.0, 1.0])
        swap = {"left": "right", "right": "left"}
        at = {
            name.replace(side, swap.get(side, side), 1): joints * flip
            for name, joints in at.items()
            for side in [name.partition("_")[0]]
        }
    across = at["left_hip"] - at["right_hip"]
    course = np.unwrap(np.arctan2(-across[:, 0], across[:, 1]))
    step = times[1] - times[0]
    course = gaussian_filter1d(course, 0.1 / step, mode="nearest")
    cos, sin = np.cos(course), np.sin(course)

    def turn_into_body(vectors: Floats) -> Floats:
        """Return vectors in forward, left, up, of unit length."""
        x, y = vectors[..., 0], vectors[..., 1]
        local = np.stack([cos * x + sin * y, cos * y - sin * x, vectors[..., 2]], axis=-1)
        return np.asarray(local / np.linalg.norm(local, axis=-1, keepdims=True))

    def limb(begin: str, end: str) -> Floats:
        sides = [
            turn_into_body(at[f"{side}_{end}"] - at[f"{side}_{begin}"])
            for side in ("left", "right")
        ]
        return np.stack(sides, axis=1)

    middle = 0.5 * (at["left_hip"] + at["right_hip"])
    ankles = np.stack([at["left_ankle"], at["right_ankle"]], axis=1)
    level = float(np.quantile(ankles[..., 2], 0.05))
    speed = np.linalg.norm(np.gradient(ankles, step, axis=0), axis=-1)
    planted = (speed < PLANTED[0]) & (ankles[..., 2] < level + PLANTED[1])
    joints = motion.joints
    leg = float(
        np.linalg.norm(joints["left_hip"] - joints["left_knee"], axis=-1).mean()
        + np.linalg.norm(joints["left_knee"] - joints["left_ankle"], axis=-1).mean()
    )
    scale, direction = skeleton.leg / leg, float(rng.uniform(-np.pi, np.pi))
    turn = np.array(
        [[np.cos(direction), -np.sin(direction)], [np.sin(direction), np.cos(direction)]]
    )
    path = scale * (middle[:, :2] - middle[len(times) // 2, :2]) @ turn.T + place
    source = (
        f"recording {motion.name}, from {begin:.2f} s, tempo {tempo:.2f}"
        f"{', left and right exchanged' if mirrored else ''}"
    )
    head_up = turn_into_body(at["head"] - at["neck"])
    shoulders = turn_into_body(at["left_shoulder"] - at["right_shoulder"])
    gaze = np.cross(shoulders, head_up)
    posture = Posture(
        hips=turn_into_body(across),
        trunk=turn_into_body(at["neck"] - middle),
        shoulders=shoulders,
        head_up=head_up,
        gaze=np.asarray(gaze / np.linalg.norm(gaze, axis=-1, keepdims=True)),
        upper_arm=limb("shoulder", "elbow"),
        forearm=limb("elbow", "wrist"),
        thigh=limb("hip", "knee"),
        shank=limb("knee", "ankle"),
        height=(middle[:, 2] - level) / leg,
        planted=planted,
    )
    return Trajectory(times, path, course + direction, source), posture
