"""Retargeting of motion capture: bone directions of a clip on a person's own bones."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.errors import InputError
from worldpose.simulation.bodies import Body
from worldpose.simulation.bvh import Capture, Clip, read_bvh
from worldpose.simulation.paths import STEP, GroundPath
from worldpose.simulation.poses import unit

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
    capture = _read_archive(path) if path.suffix == ".npz" else read_bvh(path)
    points = _named(path, capture)
    rise = (points[:, 0:2].mean(axis=1) - points[:, 6:8].mean(axis=1)).mean(axis=0)
    if np.argmax(np.abs(rise)) == 1:
        points = points[..., [2, 0, 1]]
    length = _leg(points)
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
        clip: as read.
        like: place of the person at time 0, and times of the path.
        body: target of the clip's leg length.
    """
    x, y, heading = (
        float(np.interp(0.0, like.time, axis)) for axis in (*like.position.T, like.heading)
    )
    points = clip.points * (body.leg / _leg(clip.points)) @ _about_z(-heading) + [x, y, 0.0]
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
        clip: in its place.
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


def _leg(points: Floats) -> float:
    """Return the length of the left leg in the first frame."""
    thigh, shank = points[0, 8] - points[0, 6], points[0, 10] - points[0, 8]
    return float(np.linalg.norm(thigh) + np.linalg.norm(shank))


def _named(path: Path, capture: Capture) -> Floats:
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
                todo="Rename the joints as conversions of the CMU database have them.",
            )
        found.append(match)
    points: Floats = capture.positions[:, found]
    if len(points) < 2 or _leg(points) == 0.0:
        raise InputError(
            str(path),
            expected="two frames or more of a person with legs",
            found=f"{len(points)} frames, legs of length {_leg(points) if len(points) else 0:g}",
            todo="Export the clip again.",
        )
    return points


def _read_archive(path: Path) -> Capture:
    try:
        with np.load(path, allow_pickle=False) as file:
            joints, fps = np.asarray(file["joints"], dtype=np.float64), float(file["fps"])
            names = tuple(str(name) for name in file["joint_names"])
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path),
            expected="npz with joints (frames, joints, 3), joint_names (joints,) and fps",
            found=f"{error}",
            todo="Give that, or a BVH file.",
        ) from error
    if joints.ndim != 3 or joints.shape[1:] != (len(names), 3) or not fps > 0.0:
        raise InputError(
            str(path),
            expected="joints (frames, joints, 3) of as many names, and fps above 0",
            found=f"joints {joints.shape}, {len(names)} names, fps {fps:g}",
            todo="Give that, or a BVH file.",
        )
    return Capture(names, np.full(len(names), -1), joints, 1.0 / fps)
