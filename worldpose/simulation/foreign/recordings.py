"""Recordings to replay: motion capture in metres with z up, and tracking data, from npz files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.simulation.foreign.skeletons import Posture, Skeleton
from worldpose.simulation.foreign.trajectories import LEAD, Trajectory
from worldpose.simulation.recorded_files import (
    LIMBS,
    Tracking,
    read_archive,
    read_capture,
    read_tracking,
    refuse,
)

JOINTS: Final = {"neck": ("neck",), "head": ("head",), **LIMBS}
"""Joints of a motion and their names."""
PLANTED: Final = (0.55, 0.06)
"""An ankle slower than this [m/s] and at most this far above its lowest place [m] is planted."""
TEMPO: Final = (0.8, 1.15)
"""Playback speed relative to the recording [1]."""


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
class Recordings:
    """Contents of a folder of recordings."""

    motions: tuple[Motion, ...] = ()
    tracks: tuple[Tracking, ...] = ()


def read_recordings(folder: Path) -> Recordings:
    """Return motions and tracking data below a folder by file name; InputError without any."""
    jump = 15.0  # a joint this fast at the beginning ends a calibration pose [m/s]
    expected = "a folder with npz files of motion capture or tracking data"
    if not folder.is_dir():
        raise refuse(
            folder, expected, "no folder", "Pass an existing folder, or omit --recordings."
        )
    motions: list[Motion] = []
    tracks: list[Tracking] = []
    for path in sorted(folder.rglob("*.npz")):
        content = read_archive(path)
        if {"joints", "joint_names", "fps"} <= content.keys():
            capture = read_capture(path, content)
            points = capture.select(path, JOINTS)
            if len(points) < 10:
                raise refuse(path, "10 frames or more", f"{len(points)} frames")
            speed = np.linalg.norm(np.diff(capture.positions, axis=0), axis=-1).max(axis=1)
            early = np.flatnonzero(speed[: len(speed) // 4] > jump / capture.fps)
            points = points[early[-1] + 2 :] if len(early) else points
            joints = dict(zip(JOINTS, np.moveaxis(points, 1, 0), strict=True))
            motions.append(Motion(path.stem, capture.fps, joints))
        elif "xy" in content and content["xy"].ndim == 3:
            tracks += [
                each
                for each in read_tracking(path, content)
                if len(each.clock) > 3 and np.isfinite(each.xy).all(axis=(0, 2)).any()
            ]
    if not motions and not tracks:
        raise refuse(folder, expected, "none")
    return Recordings(tuple(motions), tuple(tracks))


def play_motion(
    motion: Motion, skeleton: Skeleton, times: Floats, place: Floats, rng: np.random.Generator
) -> tuple[Trajectory, Posture]:
    """Return the trajectory and posture of a person who replays a motion.

    Bone directions are those of the recording; the length of the legs scales trajectory and height.
    Part, direction, tempo and left-right mirroring are random; at the ends of the recording the
    playback reverses.

    `times` (frames,) [s] are evenly spaced, and the clip begins at 0; `place` (2,) [m] is the
    person's in the middle of them.
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
