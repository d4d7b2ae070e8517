"""Skeletons from anthropometric tables, and joints from bone directions.

Segment lengths are shares of stature after P. de Leva, Adjustments to Zatsiorsky-Seluyanov's
segment inertia parameters, Journal of Biomechanics 29, 1996 (men of 1.741 m, women of 1.735 m), and
R. Drillis, R. Contini, Body segment parameters, 1966; face and neck after the means of the ANSUR
survey of 1988. No body model is involved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from data_contracts.arrays import Flags, Floats
from worldpose.geometry.rigid import unit

Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""
Kind = Literal["man", "woman", "child"]

STATURE: Final[dict[Kind, tuple[float, float]]] = {
    "man": (1.78, 0.075),
    "woman": (1.66, 0.068),
    "child": (1.38, 0.11),
}
"""Mean and standard deviation [m]; a child of about ten years."""
_BONES: Final = (
    *("thigh", "shank", "ankle", "upper_arm", "forearm", "trunk", "hips", "shoulders"),
    *("drop", "neck", "head"),
)
SHARES: Final[dict[Kind, tuple[float, ...]]] = {
    "man": (0.2425, 0.2493, 0.043, 0.1618, 0.1545, 0.332, 0.098, 0.205, 0.058, 0.060, 1.0),
    "woman": (0.2290, 0.2500, 0.041, 0.1586, 0.1523, 0.346, 0.105, 0.194, 0.055, 0.058, 0.96),
    "child": (0.2320, 0.2400, 0.046, 0.1550, 0.1440, 0.338, 0.096, 0.192, 0.055, 0.058, 0.93),
}
"""Bones as shares of stature [1]; `drop`, distance of the shoulders' centres below the neck along
the trunk; `head`, the size of the face relative to a man's."""
FACE: Final = np.array(
    [
        [0.118, 0.086, 0.086, 0.0, 0.0],
        [0.0, 0.032, -0.032, 0.073, -0.073],
        [-0.020, 0.018, 0.018, 0.0, 0.0],
    ]
).T
"""Nose, eyes and ears [m] forward, left and up of the middle between the ears."""


@dataclass(frozen=True)
class Skeleton:
    """One person's bones.

    Attributes:
        kind: kind of person, which gives the mean proportions.
        stature: [m].
        thigh, shank, upper_arm, forearm: left and right [m].
        ankle: height of the ankle's centre above the sole [m].
        trunk: length from the middle of the hips to the base of the neck [m].
        hips, shoulders: distance between the joints' centres [m].
        drop: length from the neck's base down to the line of the shoulders [m].
        neck: length from the neck's base up to the ears [m].
        head: size of the face relative to `FACE` [1].
    """

    kind: Kind
    stature: float
    thigh: tuple[float, float]
    shank: tuple[float, float]
    upper_arm: tuple[float, float]
    forearm: tuple[float, float]
    ankle: float
    trunk: float
    hips: float
    shoulders: float
    drop: float
    neck: float
    head: float

    @property
    def leg(self) -> float:
        """Length of the shorter leg [m]."""
        return min(t + s for t, s in zip(self.thigh, self.shank, strict=True))


@dataclass(frozen=True, eq=False)
class Posture:
    """Bone directions over time: unit vectors (frames, 3) forward, left, up of the heading.

    Attributes:
        hips, shoulders: from right to left.
        trunk: vector from the middle of the hips to the neck's base.
        head_up, gaze: axis of the head, and direction of the face.
        upper_arm, forearm, thigh, shank: (frames, 2, 3), left and right, towards the end of the
            limb.
        height: (frames,) height of the middle of the hips above the ankles' level on the ground, as
            a share of the leg's length [1].
        planted: (frames, 2), left and right: the ankle does not move.
    """

    hips: Floats
    trunk: Floats
    shoulders: Floats
    head_up: Floats
    gaze: Floats
    upper_arm: Floats
    forearm: Floats
    thigh: Floats
    shank: Floats
    height: Floats
    planted: Flags


def draw_skeleton(kind: Kind, rng: np.random.Generator) -> Skeleton:
    """Return a person of this kind: stature, proportions and a slight asymmetry."""
    mean, spread = STATURE[kind]
    stature = float(mean + spread * np.clip(rng.standard_normal(), -2.2, 2.2))
    shares = SHARES[kind]
    deviation = np.clip(rng.standard_normal(len(shares)), -2.5, 2.5)
    share_spread = 0.035  # of a person's share relative to the mean, standard deviation [1]
    varied = np.array(shares) * (1.0 + share_spread * deviation)
    own: dict[str, Any] = dict(zip(_BONES, varied, strict=True))
    for name in own.keys() - {"head"}:
        own[name] *= stature
    for name in ("thigh", "shank", "upper_arm", "forearm"):
        uneven = 0.004 * rng.standard_normal()
        own[name] = own[name] * (1.0 + uneven), own[name] * (1.0 - uneven)
    return Skeleton(kind, stature, **own)


def place_joints(
    skeleton: Skeleton, posture: Posture, root: Floats, heading: Floats, fps: float, ground: Ground
) -> Floats:
    """Return anatomical joints (frames, 17, 3) [m], world, in COCO-17 order.

    Bone lengths are exact. Planted ankles are fixed as in L. Kovar, J. Schreiner, M. Gleicher,
    Footskate cleanup for motion capture editing, 2002: the limb's own trajectory is shifted while a
    foot is planted, the shift fades over to the next in between, the pelvis sinks where the legs do
    not reach, and knees follow from thigh and shank.

    `root` (frames, 2) [m] is the middle of the hips in plan, world; `heading` (frames,) is the
    angle from the x axis towards y [rad].
    """
    neck_forward = 0.6  # ears' distance before the neck's base by their height above it [1]
    frames = len(root)
    turn = _heading_rotations(heading)
    world = {
        name: np.einsum("fij,fj->fi", turn, getattr(posture, name))
        for name in ("hips", "trunk", "shoulders", "head_up", "gaze")
    }
    limbs = {
        name: np.einsum("fij,fsj->fsi", turn, getattr(posture, name))
        for name in ("upper_arm", "forearm", "thigh", "shank")
    }
    pelvis = np.empty((frames, 3))
    pelvis[:, :2] = root
    pelvis[:, 2] = ground(*root.T) + skeleton.ankle + posture.height * skeleton.leg
    sides = np.array([0.5, -0.5])
    hip_offset = skeleton.hips * sides[:, None] * world["hips"][:, None]
    lengths = np.stack([skeleton.thigh, skeleton.shank])
    swung = pelvis[:, None] + hip_offset
    swung = swung + lengths[0][:, None] * limbs["thigh"] + lengths[1][:, None] * limbs["shank"]
    held = (
        _hold_ankle(swung[:, side], posture.planted[:, side], skeleton.ankle, ground)
        for side in range(2)
    )
    ankles, hips = np.stack([*held], axis=1), pelvis[:, None] + hip_offset
    pelvis[:, 2] -= _pelvis_drop(hips, ankles, posture.planted, lengths, fps)
    hips = pelvis[:, None] + hip_offset
    pole = limbs["thigh"] - limbs["shank"] + 0.05 * turn[:, None, :, 0]
    knees, ankles = _solve_knees(hips, ankles, pole, lengths)

    neck = pelvis + skeleton.trunk * world["trunk"]
    middle = neck - skeleton.drop * world["trunk"]
    shoulders = middle[:, None] + skeleton.shoulders * sides[:, None] * world["shoulders"][:, None]
    elbows = shoulders + np.array(skeleton.upper_arm)[:, None] * limbs["upper_arm"]
    wrists = elbows + np.array(skeleton.forearm)[:, None] * limbs["forearm"]
    up = world["head_up"]
    gaze = unit(world["gaze"] - (world["gaze"] * up).sum(-1, keepdims=True) * up)
    axes = np.stack([gaze, np.cross(up, gaze), up], axis=1)
    ears = neck + skeleton.neck * (world["trunk"] + neck_forward * gaze)
    face = ears[:, None] + skeleton.head * FACE @ axes
    return np.concatenate([face, shoulders, elbows, wrists, hips, knees, ankles], axis=1)


def _heading_rotations(heading: Floats) -> Floats:
    """Return rotations (frames, 3, 3) from forward, left, up to the world."""
    rotations = np.zeros((len(heading), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(heading)
    rotations[:, 1, 0], rotations[:, 0, 1] = np.sin(heading), -np.sin(heading)
    rotations[:, 2, 2] = 1.0
    return rotations


def _hold_ankle(course: Floats, planted: Flags, ankle: float, ground: Ground) -> Floats:
    """Return an ankle's trajectory (frames, 3), at rest on the ground while it is planted."""
    frames = len(course)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], planted, [False]]).astype(np.int8)))
    shift = np.zeros((frames, 3))
    known: list[int] = []
    for begin, end in edges.reshape(-1, 2):
        place = course[(begin + end - 1) // 2].copy()
        place[2] = float(ground(place[:1], place[1:2])[0]) + ankle
        shift[begin:end] = place - course[begin:end]
        known += [int(begin), int(end) - 1]
    if known:
        shift[: known[0]], shift[known[-1] :] = shift[known[0]], shift[known[-1]]
        for leave, land in zip(known[1:-1:2], known[2::2], strict=True):
            share = np.linspace(0.0, 1.0, land - leave + 1)[:, None]
            share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            shift[leave : land + 1] = (1.0 - share) * shift[leave] + share * shift[land]
    held = course + shift
    floor = ground(held[:, 0], held[:, 1]) + ankle
    held[:, 2] = np.maximum(held[:, 2], floor)
    return held


def _pelvis_drop(
    hips: Floats, ankles: Floats, planted: Flags, lengths: Floats, fps: float
) -> Floats:
    """Return the pelvis' drop (frames,) [m] that puts planted ankles within reach."""
    settling = 0.08  # smoothing in time of the pelvis' drop, standard deviation [s]
    reach = 0.998 * lengths.sum(axis=0)
    away = np.linalg.norm((ankles - hips)[..., :2], axis=-1)
    highest = ankles[..., 2] + np.sqrt(np.maximum(reach**2 - away**2, 0.0))
    slack = np.where(planted, highest - hips[..., 2], np.inf).min(axis=1)
    slack = np.minimum(slack, 0.0)
    half = max(1, round(3.0 * settling * fps))
    lowest = minimum_filter1d(slack, 2 * half + 1, mode="nearest")
    return np.asarray(-gaussian_filter1d(lowest, settling * fps, mode="nearest", truncate=3.0))


def _solve_knees(
    hips: Floats, ankles: Floats, pole: Floats, lengths: Floats
) -> tuple[Floats, Floats]:
    """Return knees and reachable ankles (frames, 2, 3): the knee bends towards the pole."""
    thigh, shank = lengths[0][:, None], lengths[1][:, None]
    line = ankles - hips
    far = np.linalg.norm(line, axis=-1, keepdims=True)
    along = line / far
    far = np.clip(far, 1.05 * np.abs(thigh - shank) + 0.05, 0.9995 * (thigh + shank))
    across = unit(pole - (pole * along).sum(-1, keepdims=True) * along)
    part = (far**2 + thigh**2 - shank**2) / (2.0 * far)
    out = np.sqrt(np.maximum(thigh**2 - part**2, 0.0))
    return hips + part * along + out * across, hips + far * along
