"""Plants faults in random camera rigs and counts faults that are found and named.

    python benchmarks/camera_faults.py [--rigs 60] [--seed 0] [--data FOLDER]

Half of the rigs have one fault each, of each kind in turn; the other half have none. Rigs, people
and detector are drawn here and share no code with `worldpose.simulation`: 4 to 18 cameras at
heights of 2 to 35 m, focal lengths from wide to long, people on recorded players' paths (FOLDER, or
WORLDPOSE_TEST_DATA) or on random ones, as stick models or motion capture, and a detector with a
bias, heavy tails, misses, false positives and an uninformative confidence.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.consistency import check_consistency
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

KINDS = ("flipped", "mirrored", "focal", "lens", "clock", "frame_rate", "swapped", "duplicate")
"""COCO-17 with left and right swapped."""


@dataclass
class RandomRig:
    """Calibrated cameras and detections in their videos.

    Attributes:
        cameras: stated in the match folder.
        true: the true cameras.
        covariance: (cameras, 12, 12) of the stated cameras; None = not given.
        keypoints: (frames, cameras, detections, 17, 2) [px].
        confidence: (frames, cameras, detections, 17).
        fps: frames per second [1/s].
        pitch_size: length and width [m].
        fault: kind of the planted fault; None = none.
        faulty: cameras that count as correct when named.
        about: planted fault, for the report.
        world: (frames at 100 Hz, persons, 17, 3) [m].
    """

    cameras: list[Camera]
    true: list[Camera]
    covariance: Floats | None
    keypoints: Floats
    confidence: Floats
    fps: float
    pitch_size: tuple[float, float] | None
    fault: str | None = None
    faulty: tuple[int, ...] = ()
    about: str = ""


# --- people ---------------------------------------------------------------------------------


def recorded_paths(data: Path | None, rng: np.random.Generator) -> tuple[Floats, float] | None:
    """Return paths of real players (frames, persons, 2) [m] and their rate; None without data."""
    if data is None or not (data / "trajectories").is_dir():
        return None
    name = rng.choice(["last_row_liv_che", "soccertrack_gnss_30s"])
    with np.load(data / "trajectories" / f"{name}.npz") as file:
        xy, fps = file["xy"].astype(float), float(file["fps"])
    xy = xy[:, np.isfinite(xy).all(axis=(0, 2))]
    if name.startswith("soccertrack"):
        xy = xy - np.median(xy, axis=(0, 1)) + rng.uniform([-15, -8], [15, 8])
    xy = xy * rng.choice([-1.0, 1.0], size=2)
    return xy, fps


def random_paths(rng: np.random.Generator) -> tuple[Floats, float]:
    """Return random walks (frames, persons, 2) [m] at 20 Hz."""
    count, steps = int(rng.integers(5, 22)), 400
    start = rng.normal([rng.uniform(-25, 25), rng.uniform(-10, 10)], [14.0, 10.0], (count, 2))
    speed = rng.gamma(2.0, 1.2, (count, 1))
    angle = rng.uniform(0, 2 * np.pi, (count, 1)) + np.cumsum(
        rng.normal(0, 0.12, (count, steps)), axis=1
    )
    pace = speed * (1.0 + 0.4 * np.sin(np.linspace(0, 9, steps) + rng.uniform(0, 6, (count, 1))))
    way = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], -1) * pace[..., None] / 20.0, axis=1)
    return (start[:, None] + way).swapaxes(0, 1), 20.0


def stick_figure(path: Floats, rate: float, rng: np.random.Generator) -> Floats:
    """Return joints (frames, 17, 3) [m] of a person who walks along a path (frames, 2)."""
    velocity = np.gradient(path, axis=0) * rate
    kernel = np.ones(round(0.3 * rate)) / round(0.3 * rate)
    velocity = np.stack([np.convolve(v, kernel, "same") for v in velocity.T], axis=-1)
    speed = np.linalg.norm(velocity, axis=-1)
    turn = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    heading = np.where(speed > 0.3, turn, turn[np.argmax(speed)]) + rng.normal(0, 0.2)
    phase = np.cumsum(2 * np.pi * (0.5 + 0.35 * speed) / rate) + rng.uniform(0, 6)
    swing = np.clip(0.25 * speed, 0.03, 0.9)
    size = rng.normal(1.0, 0.05)
    leg, shank, torso = size * 0.43, size * 0.42, size * 0.52
    forward = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=-1)
    left = np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    root = np.concatenate([path, np.full((len(path), 1), 0.06 + leg + shank)], axis=-1)
    root = root + (0.03 * np.cos(2 * phase))[:, None] * up - 0.04 * swing[:, None] * up
    lean = 0.06 * np.clip(speed, 0, 6)
    neck = root + torso * (np.cos(lean)[:, None] * up + np.sin(lean)[:, None] * forward)
    joints = np.zeros((len(path), 17, 3))

    def along(angle: Floats) -> Floats:
        swung: Floats = np.sin(angle)[:, None] * forward - np.cos(angle)[:, None] * up
        return swung

    joints[:, 0] = neck + size * (0.2 * up + 0.1 * forward)
    for side, sign in ((0, 1.0), (1, -1.0)):
        thigh = swing * np.sin(phase + np.pi * side)
        bend = 0.15 + swing * (0.6 - 0.6 * np.cos(phase + np.pi * side - 0.8))
        arm = -0.8 * thigh
        hip, shoulder = root + 0.1 * sign * size * left, neck + 0.18 * sign * size * left
        knee = hip + leg * along(thigh)
        elbow = shoulder + 0.29 * size * along(arm)
        joints[:, 1 + side] = joints[:, 0] + size * (0.03 * up + 0.03 * sign * left)
        joints[:, 3 + side] = joints[:, 0] + size * (0.02 * up + 0.075 * sign * left)
        joints[:, 3 + side] -= 0.09 * size * forward
        joints[:, 5 + side], joints[:, 7 + side] = shoulder, elbow
        joints[:, 9 + side] = elbow + 0.26 * size * along(arm + 0.5 + 0.3 * swing)
        joints[:, 11 + side], joints[:, 13 + side] = hip, knee
        joints[:, 15 + side] = knee + shank * along(thigh - bend)
    return joints


def captured_figure(path: Floats, rate: float, data: Path, rng: np.random.Generator) -> Floats:
    """Return joints (frames, 17, 3) [m] of a motion capture clip moved along a path."""
    name = rng.choice(["cmu_10_01", "cmu_10_03"])
    with np.load(data / "mocap" / f"{name}.npz") as file:
        joints, names = file["joints"].astype(float), file["joint_names"].tolist()
        fps = float(file["fps"])
    frames = (np.arange(len(path)) * fps / rate + rng.uniform(0, 200)) % (2 * len(joints) - 2)
    frames = np.where(frames >= len(joints), 2 * len(joints) - 2 - frames, frames)
    pose = joints[np.round(frames).astype(int).clip(0, len(joints) - 1)]
    pose[..., :2] -= pose[:, :1, :2]
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pose[..., :2] = pose[..., :2] @ turn.T
    at = {name: pose[:, index] for index, name in enumerate(names)}
    out = np.zeros((len(path), 17, 3))
    across = at["lShldr"] - at["rShldr"]
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    front = np.cross(across, [0.0, 0.0, 1.0])
    out[:, 0] = at["head"] + 0.1 * front
    for side, letter in ((0, "l"), (1, "r")):
        sign = 1.0 - 2.0 * side
        out[:, 1 + side] = out[:, 0] + 0.03 * sign * across + [0, 0, 0.03]
        out[:, 3 + side] = at["head"] + 0.08 * sign * across
        for joint, part in zip(
            (5, 7, 9, 11, 13, 15),
            ("Shldr", "ForeArm", "Hand", "Thigh", "Shin", "Foot"),
            strict=True,
        ):
            out[:, joint + side] = at[letter + part]
    out[..., :2] += path[:, None]
    return out


def people(seconds: float, data: Path | None, rng: np.random.Generator) -> Floats:
    """Return joints (frames at 100 Hz, persons, 17, 3) [m] of people on a pitch."""
    found = recorded_paths(data, rng) if rng.random() < 0.7 else None
    xy, fps = found if found is not None else random_paths(rng)
    wanted = min(seconds, (len(xy) - 1) / fps - 0.1)
    start = rng.uniform(0, (len(xy) - 1) / fps - wanted)
    t = start + np.arange(int(wanted * 100)) / 100.0
    smooth = np.stack(
        [
            [np.interp(t, np.arange(len(xy)) / fps, xy[:, p, axis]) for axis in (0, 1)]
            for p in range(xy.shape[1])
        ]
    )
    kernel = np.hanning(51) / np.hanning(51).sum()
    padded = np.pad(smooth, ((0, 0), (0, 0), (25, 25)), mode="reflect", reflect_type="odd")
    paths = np.apply_along_axis(lambda x: np.convolve(x, kernel, "valid"), -1, padded)
    figures = []
    for path in paths:
        if data is not None and (data / "mocap").is_dir() and rng.random() < 0.3:
            figures.append(captured_figure(path.T, 100.0, data, rng))
        else:
            figures.append(stick_figure(path.T, 100.0, rng))
    return np.stack(figures, axis=1)


# --- cameras --------------------------------------------------------------------------------


def look_at(
    center: Floats,
    target: Floats,
    focal: float,
    distortion: Floats,
    size: tuple[int, int],
    roll: float = 0.0,
) -> Camera:
    """Return a camera at `center` that looks at `target`."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    x = np.cos(roll) * x + np.sin(roll) * np.cross(z, x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Camera(
        focal=np.full(2, focal),
        principal_point=(np.array(size) - 1.0) / 2.0,
        distortion=distortion,
        cam_from_world=Rigid(rotation, -rotation @ center),
        image_size=np.array(size),
    )


def random_camera(middle: Floats, rng: np.random.Generator) -> Camera:
    """Return a camera off the pitch that looks at the play around `middle` (2,) [m]."""
    size = [(1920, 1080), (1280, 720), (3840, 2160)][rng.choice(3, p=[0.7, 0.2, 0.1])]
    angle = rng.uniform(0, 2 * np.pi)
    away = rng.uniform(4.0, 30.0)
    edge = min(52.5 / max(abs(np.cos(angle)), 1e-6), 34.0 / max(abs(np.sin(angle)), 1e-6))
    ground = (edge + away) * np.array([np.cos(angle), np.sin(angle)])
    height = float(np.exp(rng.uniform(np.log(2.5), np.log(35.0))))
    target = np.append(middle + rng.normal(0, [9.0, 6.0]), 1.0)
    center = np.append(ground, height)
    distance = np.linalg.norm(target - center)
    wide = rng.random() < 0.3
    seen = rng.uniform(25.0, 70.0) if not wide else rng.uniform(60.0, 110.0)
    focal = size[0] * float(np.clip(distance / seen, 0.45, 2.5))
    half = 0.5 * np.hypot(*size) / focal
    radius = np.linspace(0.0, 1.6 * half, 200)
    for _ in range(1000):
        k1 = rng.uniform(-0.3, -0.1) if wide or half > 0.7 else rng.uniform(-0.15, 0.1)
        k2, k3 = rng.uniform(-0.5, 1.0) * abs(k1), rng.uniform(-0.3, 0.3) * abs(k1)
        lens = np.array([k1, k2, *rng.normal(0, 0.0015, 2), k3])
        bent = radius * (1.0 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
        if (np.diff(bent) > 0.0).all():  # one to one over the image
            break
    else:
        lens = np.zeros(5)
    return look_at(center, target, focal, lens, size, rng.normal(0, 0.01))


def perturb(camera: Camera, sigma: Floats, rng: np.random.Generator) -> Camera:
    """Return the camera with a random calibration error of `sigma` (12,)."""
    step = rng.normal(0, sigma)
    pose = camera.cam_from_world
    turned = Rigid.from_rotvec(step[:3], np.zeros(3)) @ Rigid(pose.rotation, pose.translation)
    return replace(
        camera,
        focal=camera.focal * np.exp(step[6]),
        cam_from_world=Rigid(turned.rotation, -turned.rotation @ (camera.center + step[3:6])),
    )


# --- detector -------------------------------------------------------------------------------


@dataclass
class Detector:
    """A detector with random errors: bias and noise in units of the person's height."""

    bias: Floats
    noise: float
    tail: float
    misses: float
    joint_misses: float
    false_people: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Detector:
        """Draw a detector."""
        return cls(
            bias=rng.normal(0, 0.012, (17, 2)),
            noise=float(rng.uniform(0.01, 0.03)),
            tail=float(rng.uniform(2.5, 5.0)),
            misses=float(rng.uniform(0.02, 0.2)),
            joint_misses=float(rng.uniform(0.0, 0.15)),
            false_people=float(rng.uniform(0.0, 1.5)),
        )


def detect(
    camera: Camera, world: Floats, detector: Detector, rng: np.random.Generator
) -> tuple[list[list[Floats]], Flags]:
    """Return the detections of every frame, each (17, 2) [px], and the number of people in view."""
    image = camera.project(world.reshape(-1, 3)).reshape(*world.shape[:3], 2)
    size = camera.image_size
    frames, persons = image.shape[:2]
    inside = np.all(np.isfinite(image) & (image >= 0) & (image < size), axis=-1)
    visible = inside.mean(axis=-1) > 0.6
    height = np.nanmax(image[..., 1], -1) - np.nanmin(image[..., 1], -1)
    # Occluded people: a nearer person covers the same place in the image.
    depth = np.linalg.norm(world.mean(axis=2) - camera.center, axis=-1)
    middle = image.mean(axis=2)
    found: list[list[Floats]] = []
    away = np.zeros(persons)
    drift = rng.normal(0, 1, (persons, 17, 2))
    ghosts = [
        (rng.uniform([0, 0.3], [1, 1]) * size, rng.integers(persons))
        for _ in range(rng.poisson(detector.false_people))
    ]
    for t in range(frames):
        here = []
        drift = 0.9 * drift + np.sqrt(0.19) * rng.normal(0, 1, drift.shape)
        away = np.where(away > 0, away - 1, away)
        gone = rng.random(persons) < detector.misses / 5.0
        away = np.where(gone & (away == 0), rng.geometric(0.2, persons), away)
        for p in np.flatnonzero(visible[t] & (away == 0)):
            near = (np.abs(middle[t] - middle[t, p]) < height[t, p] * np.array([0.15, 0.3])).all(-1)
            if (near & (depth[t] < depth[t, p] - 0.3)).any() and rng.random() < 0.7:
                continue
            scale = height[t, p]
            heavy = rng.standard_t(detector.tail, (17, 2))
            error = detector.bias + detector.noise * (0.6 * drift[p] + 0.6 * heavy)
            joints = image[t, p] + error * scale + rng.normal(0, 0.5, (17, 2))
            joints[~inside[t, p] | (rng.random(17) < detector.joint_misses)] = np.nan
            if rng.random() < 0.03:
                joints = joints[list(COCO17_FLIP)]
            here.append(joints)
        for place, model in ghosts:
            if rng.random() < 0.6 and np.isfinite(image[t, model]).all():
                shape = image[t, model] - image[t, model].mean(0)
                here.append(place + shape + rng.normal(0, 2.0, (17, 2)))
        order = rng.permutation(len(here))
        found.append([here[k] for k in order])
    return found, visible


def pad(found: list[list[list[Floats]]]) -> Floats:
    """Return (frames, cameras, detections, 17, 2) from each camera's people of every frame."""
    frames = max(len(camera) for camera in found)
    most = max(1, *(len(frame) for camera in found for frame in camera))
    out = np.full((frames, len(found), most, 17, 2), np.nan)
    for c, camera in enumerate(found):
        for t, frame in enumerate(camera):
            for d, joints in enumerate(frame):
                out[t, c, d] = joints
    return out


# --- faults ---------------------------------------------------------------------------------

LENS_ORDERS = ([0, 1, 3, 4, 2], [0, 1, 4, 2, 3], [2, 3, 0, 1, 4])
"""Positions from which a reader with another order takes k1 k2 p1 p2 k3."""


def with_pose(camera: Camera, rotation: Floats, center: Floats) -> Camera:
    """Return the camera with another pose."""
    return replace(camera, cam_from_world=Rigid(rotation, -rotation @ center))


def plant(
    kind: str,
    rig: RandomRig,
    eligible: list[int],
    world: Floats,
    detector: Detector,
    rng: np.random.Generator,
) -> bool:
    """Plant a fault into the rig; return False, with the rig unchanged, if it cannot have it."""
    c = int(rng.choice(eligible))
    camera = rig.cameras[c]
    rotation, center = camera.cam_from_world.rotation, camera.center
    faulty: tuple[int, ...] = (c,)
    if kind == "flipped":
        half = np.diag([-1.0, -1.0, 1.0])
        rig.cameras[c] = with_pose(camera, rotation @ half, half @ center)
    elif kind == "mirrored":
        way = int(rng.integers(4))
        rig.about = ("image", "left/right names", "near/far names", "mirrored pose")[way]
        if way == 0:
            points = rig.keypoints[:, c]
            points[..., 0] = camera.image_size[0] - 1.0 - points[..., 0]
            rig.keypoints[:, c] = points[..., COCO17_FLIP, :]
        elif way < 3:
            turn = np.diag([-1.0, 1.0, -1.0] if way == 1 else [1.0, -1.0, -1.0])
            rig.cameras[c] = with_pose(camera, rotation @ turn, turn @ center)
        else:
            mirror = np.diag([1.0, -1.0, 1.0] if rng.random() < 0.5 else [-1.0, 1.0, 1.0])
            flip = np.diag([-1.0, 1.0, 1.0])
            rig.cameras[c] = with_pose(camera, flip @ rotation @ mirror, mirror @ center)
    elif kind == "focal":
        ratio = float(np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(1.08), np.log(1.35))))
        rig.about = f"x {ratio:.3f}"
        rig.cameras[c] = replace(camera, focal=camera.focal * ratio)
    elif kind == "lens":
        order = LENS_ORDERS[int(rng.integers(len(LENS_ORDERS)))]
        misread = replace(camera, distortion=camera.distortion[order])
        shift = lens_shift(rig.true[c], misread, world)
        if not shift > 4.0:
            return False
        rig.cameras[c] = misread
        rig.about = f"{order} {shift:.0f} px"
    elif kind in ("clock", "frame_rate"):
        frames = len(rig.keypoints)
        if kind == "clock":
            late = int(rng.choice([-1, 1]) * rng.integers(4, min(40, frames // 3)))
            time = np.arange(frames) + late
            rig.about = f"{late} frames"
        else:
            rate = float(rng.choice([0.5, 2.0, 25 / 30, 30 / 25, 24 / 25, 25 / 24, 50 / 60]))
            time = np.round(np.arange(frames) * rate).astype(int)
            rig.about = f"x {rate:.3f}"
        inside = (time >= 0) & (time < frames)
        points = np.full_like(rig.keypoints[:, c], np.nan)
        points[inside] = rig.keypoints[time[inside], c]
        rig.keypoints[:, c] = points
    else:
        other = int(rng.choice([n for n in range(len(rig.cameras)) if n != c]))
        faulty = (c, other)
        rig.about = f"{c} and {other}"
        if kind == "swapped":
            rig.keypoints[:, [c, other]] = rig.keypoints[:, [other, c]]
        else:
            jitter = rng.normal(0, rng.choice([0.0, 0.7]), rig.keypoints[:, c].shape)
            rig.keypoints[:, other] = rig.keypoints[:, c] + jitter
            faulty = (other, c)
    rig.fault, rig.faulty = kind, faulty
    return True


def lens_shift(true: Camera, stated: Camera, world: Floats) -> float:
    """Return the mean image shift of people by a wrong lens [px]."""
    points = world[::25].reshape(-1, 3)
    a, b = true.project(points), stated.project(points)
    inside = ((a >= 0) & (a < true.image_size)).all(-1)
    return float(np.nanmean(np.linalg.norm((a - b)[inside], axis=-1)))


def draw_rig(seed: int, kind: str | None, data: Path | None) -> RandomRig:
    """Return a random rig with a fault of `kind`, or without."""
    for attempt in range(50):
        rng = np.random.default_rng([seed, attempt])
        rig = _attempt(rng, kind, data)
        if rig is not None:
            return rig
    raise RuntimeError(f"no rig for seed {seed}")


def _attempt(rng: np.random.Generator, kind: str | None, data: Path | None) -> RandomRig | None:
    fps = float(rng.choice([25.0, 30.0, 50.0]))
    world = people(float(rng.uniform(4.0, 10.0)), data, rng)
    frames = int(len(world) / 100.0 * fps)
    count = int(rng.choice([4, 5, 6, 8, 10, 12, 15, 18]))
    middle = np.median(world[:, :, 0, :2], axis=(0, 1))
    true = [random_camera(middle, rng) for _ in range(count)]
    detector = Detector.draw(rng)
    moments = world[
        np.minimum(np.round(np.arange(frames) * 100.0 / fps).astype(int), len(world) - 1)
    ]
    found, seen = [], []
    for camera in true:
        own, visible = detect(camera, moments, detector, rng)
        found.append(own)
        seen.append(visible)
    keypoints = pad(found)
    confidence = np.where(np.isfinite(keypoints[..., 0]), rng.uniform(0.3, 1.0), np.nan)
    confidence *= rng.uniform(0.7, 1.0, confidence.shape)
    clicked = rng.random() < 0.5 and kind not in ("focal", "lens")
    cameras, covariance = [], []
    for camera in true:
        distance = float(np.linalg.norm(camera.center - np.append(middle, 1.0)))
        scale = rng.uniform(0.3, 1.5) if clicked else 0.2
        sigma = np.zeros(12)
        sigma[:3] = 0.001 * scale
        sigma[3:6] = 0.0015 * distance * scale
        sigma[6] = 0.003 * scale
        cameras.append(perturb(camera, sigma, rng))
        covariance.append(np.diag(sigma**2))
    rig = RandomRig(
        cameras,
        true,
        np.stack(covariance) if clicked else None,
        keypoints,
        confidence,
        fps,
        (105.0, 68.0) if rng.random() < 0.7 else None,
    )
    # Mean number of people that each pair of cameras sees in common.
    together = np.array([[(a & b).sum(1).mean() for b in seen] for a in seen])
    np.fill_diagonal(together, 0.0)
    eligible = [c for c in range(count) if np.sort(together[c])[-2] >= 2.0]
    if len(eligible) < 3:
        return None
    if kind is not None and not plant(kind, rig, eligible, world, detector, rng):
        return None
    rig.confidence = np.where(np.isfinite(rig.keypoints[..., 0]), 0.8, np.nan)
    return rig


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=os.environ.get("WORLDPOSE_TEST_DATA"))
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    options = parser.parse_args()
    data = None if options.data is None else Path(options.data)
    if data is not None and not all((data / name).is_dir() for name in ("trajectories", "mocap")):
        parser.error(
            f"{data}: expected folders trajectories and mocap; without --data none is used"
        )
    named: Counter[str] = Counter()
    planted: Counter[str] = Counter()
    others: Counter[str] = Counter()
    false = 0
    for n in range(options.rigs):
        kind = options.kinds[n % len(options.kinds)]
        for planted_kind in (kind, None):
            rig = draw_rig(
                options.seed * 100_000 + 2 * n + (planted_kind is None), planted_kind, data
            )
            begin = time.perf_counter()
            result = check_consistency(
                Camera.stack(rig.cameras),
                rig.covariance,
                KeypointDetections.from_keypoints(rig.keypoints, rig.confidence),
                rig.fps,
                ConsistencySettings(),
                ground=rig.pitch_size is not None,
            )
            seconds = time.perf_counter() - begin
            said = [(fault.camera, fault.kind) for fault in result.faults]
            if planted_kind is None:
                false += len(said) > 0
                right = not said
            else:
                planted[kind] += 1
                cameras = {camera for camera, _ in said}
                right = (
                    bool(said) and cameras <= set(rig.faulty) and all(k == kind for _, k in said)
                )
                named[kind] += right
                others[kind] += bool(cameras & set(rig.faulty)) and not right
            if options.verbose:
                mark = "ok " if right else "BAD"
                found = [(f.camera, f.kind, f.detail, f.value) for f in result.faults]
                print(
                    f"{mark} {n:3d} {planted_kind} {rig.about}: {len(rig.cameras)} cameras, "
                    f"{len(rig.keypoints)} frames, pitch {rig.pitch_size is not None}, "
                    f"faulty {rig.faulty}, found {found}, unconfirmed {result.unconfirmed}, "
                    f"{seconds:.1f} s",
                    flush=True,
                )
    print(f"{'planted':12s} {'rigs':>5s} {'named':>6s} {'other kind or camera too':>25s}")
    for kind in planted:
        print(f"{kind:12s} {planted[kind]:5d} {named[kind]:6d} {others[kind]:25d}")
    print(f"{'sum':12s} {planted.total():5d} {named.total():6d} {others.total():25d}")
    print(f"without a fault: {options.rigs} rigs, {false} falsely named")


if __name__ == "__main__":
    main()
