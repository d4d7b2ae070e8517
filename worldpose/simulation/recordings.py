"""Recordings that people replay: tracking data as paths, motion capture as poses."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.geometry.rigid import unit
from worldpose.simulation.paths import STEP, Clip, GroundPath, sample_times
from worldpose.simulation.recorded_files import (
    LIMBS,
    follow_track,
    read_archive,
    read_bvh,
    read_capture,
    read_tracking,
    refuse,
)
from worldpose.simulation.skeletons import Body, Ground

SMOOTHING: Final = 0.15
"""Standard deviation of the smoothing in time [s]: tracking jitters by decimetres between samples,
a runner's path does not."""


def read_trajectories(
    path: Path, duration: float, max_people: int | None = None
) -> tuple[list[GroundPath], float]:
    """Return paths of the people in a tracking file, and their duration [s], of at most `duration`.

    The longest chunk is used, with the first `max_people` of those who are present in all of it.
    InputError if the file is unreadable, has wrong shapes, or nobody is present for 0.2 s.
    """
    chunk = max(read_tracking(path, read_archive(path)), key=lambda each: len(each.clock))
    rows = chunk.clock <= duration + 1e-9
    clock, xy = chunk.clock[rows], chunk.xy[rows]
    there, length = np.isfinite(xy).all(axis=(0, 2)), float(clock[-1])
    if len(clock) < 4 or length < 0.2 or not there.any():
        raise refuse(
            path,
            "0.2 s and 4 samples or more without gaps, with a person in all of them",
            f"{len(clock)} samples, {length:.2f} s, {int(there.sum())} people",
            "Pass tracking data with a longer part without gaps.",
        )
    people = np.flatnonzero(there)[:max_people]
    return [_smooth_path(clock, xy[:, person]) for person in people], length


def _smooth_path(clock: Floats, xy: Floats) -> GroundPath:
    time = sample_times(float(clock[-1]))
    place, heading = follow_track(time, clock, xy, SMOOTHING)
    speed = np.linalg.norm(np.gradient(place, STEP, axis=0), axis=-1)
    return GroundPath(time, place, heading, speed)


_BONES: Final = ((6, 5), (12, 11), (5, 7), (7, 9), (6, 8), (8, 10), (11, 13), (13, 15), (12, 14))
"""Pairs of joints: shoulders and hips from right to left, limbs outward ..."""


def read_clip(path: Path) -> Clip:
    """Return a file's motion in metres with z up, from the origin and facing along x.

    Up is the axis along which shoulders are above hips, y or z; the unit is the one with plausible
    leg lengths; the floor is at the lowest ankles. InputError if joints are missing.
    """
    usual_leg = 0.82  # length of thigh and shank together, which identifies the unit of a file [m]
    npz = path.suffix == ".npz"
    capture = read_capture(path, read_archive(path)) if npz else read_bvh(path)
    # Points of a clip by their names.
    point_names = {**LIMBS, "head": ("head_end", "head")}
    points = capture.select(path, point_names)
    length = _leg_length(points) if len(points) else 0.0
    if len(points) < 2 or length == 0.0:
        raise refuse(
            path,
            "two frames or more of a person whose legs have a length above 0",
            f"{len(points)} frames, legs of length {length:g}",
            "Export the clip again, with all frames and the leg joints.",
        )
    rise = (points[:, 0:2].mean(axis=1) - points[:, 6:8].mean(axis=1)).mean(axis=0)
    if np.argmax(np.abs(rise)) == 1:
        points = points[..., [2, 0, 1]]
    length = _leg_length(points)
    file_units = (1.0, 0.01, 0.0254, 0.001, 0.056444)  # [m]; last, the CMU database's
    points = points * min(file_units, key=lambda metres: abs(np.log(length * metres / usual_leg)))
    across = points[0, 6] - points[0, 7]
    points = points @ _about_z(np.arctan2(-across[0], across[1]))
    start = points[0, 6:8].mean(axis=0)
    ankle_height = 0.08  # above the floor in the lowest frames [m]
    start[2] = np.percentile(points[:, 10:12, 2].min(axis=1), 2.0) - ankle_height
    time = np.arange(len(points), dtype=np.float64) / capture.fps
    return Clip(time, np.asarray(points - start, dtype=np.float64))


def clip_path(clip: Clip, like: GroundPath, body: Body) -> GroundPath:
    """Return the path of a person who plays a clip from time 0 on, and then stands.

    `like` gives the person's place at time 0, and the times of the path.
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


def play_clip(body: Body, clip: Clip, times: Floats, ground: Ground, gait: Floats) -> Floats:
    """Return joints (frames, 17, 3) [m], world: the clip's bone directions with the body's lengths.

    `times` (frames,) [s]; before and after the clip, people have the joints `gait` (frames, 17, 3).
    """
    last = (14, 16)
    ease = 0.5  # time at the end of a clip in which it blends into standing [s]
    inside = np.clip(times, 0.0, clip.time[-1])
    flat = clip.points.reshape(len(clip.time), -1)
    points = np.stack([np.interp(inside, clip.time, each) for each in flat.T], axis=-1)
    points = points.reshape(len(times), -1, 3)
    played = np.concatenate([np.zeros((len(times), 5, 3)), points[:, :12]], axis=1)
    played[:, 5:, 2] += ground(*played[:, 11:13, :2].mean(axis=1).T)[:, None]
    done = np.clip(np.minimum(times, clip.time[-1] - times) / ease, 0.0, 1.0)
    share = np.where(times < 0.5 * clip.time[-1], times >= 0.0, done**2 * (3.0 - 2.0 * done))
    share = share[:, None]

    def between(own: Floats, walked: Floats) -> Floats:
        weight = share.reshape(-1, *(1 for _ in own.shape[1:]))
        return weight * own + (1.0 - weight) * walked

    pairs = np.array([*_BONES, last])
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
    joints[:, :5] = neck[:, None] + body.face @ head
    return joints


def _about_z(angle: float) -> Floats:
    """Return the matrix that turns rows of points by minus the angle [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _leg_length(points: Floats) -> float:
    """Return the length of the left leg in the first frame."""
    thigh, shank = points[0, 8] - points[0, 6], points[0, 10] - points[0, 8]
    return float(np.linalg.norm(thigh) + np.linalg.norm(shank))
