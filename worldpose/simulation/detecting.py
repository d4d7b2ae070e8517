"""Detections of people with known pixels, with a detector's errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17, COCO17_SIGMAS
from worldpose.simulation.noise import ObservationNoise
from worldpose.simulation.occlusion import Sight, facing
from worldpose.simulation.processes import bursts, drift

DIFFICULTY: Final = np.array(COCO17_SIGMAS) / 0.08
"""Spread of each joint relative to an average one: COCO's sigmas over their mean of 0.08."""
MIRRORED: Final = np.array(
    [
        COCO17.index(name.replace("left", "*").replace("right", "left").replace("*", "right"))
        for name in COCO17
    ]
)
"""The same joint on the other side."""
MOSTLY_HIDDEN: Final = 0.7
"""Share of hidden joints above which a person is mostly hidden."""
DISPLACED: Final = (4.0, 10.0)
"""Offset of displaced joints, in standard deviations of their error."""
_SIDE: Final = np.array([("left" in name) - ("right" in name) for name in COCO17], dtype=float)


@dataclass(frozen=True, eq=False)
class Habits:
    """Systematic errors of one detector.

    Attributes:
        joint_bias: (17, 3) forward, left, up [standard deviations], a mirror image of itself.
        view_bias: (17, 2, 2) of the cosine and the sine of twice the azimuth, along the image
            axes [standard deviations].
    """

    joint_bias: Floats
    view_bias: Floats


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of every body, in the bodies' order.

    Attributes:
        keypoints: (frames, persons, 17, 2) [px]; NaN where not found.
        confidence: (frames, persons, 17); NaN where not found.
        displaced: (frames, persons, 17), joints with gross errors.
        merged_into: (frames, persons) int16, the person whose box includes this lost one; -1 =
            none.
    """

    keypoints: Floats
    confidence: Floats
    displaced: Flags
    merged_into: NDArray[np.int16]


def draw_habits(rng: np.random.Generator) -> Habits:
    """Return a detector, drawn once per match for all cameras and people."""
    joint_bias = rng.standard_normal((17, 3))
    for joint, mirror in enumerate(MIRRORED):
        if _SIDE[joint] < 0.0:
            joint_bias[joint] = joint_bias[mirror] * [1.0, -1.0, 1.0]
    joint_bias[_SIDE == 0.0, 1] = 0.0
    return Habits(joint_bias, rng.standard_normal((17, 2, 2)))


def perceived_bias(joints: Floats, habits: Habits, noise: ObservationNoise, own: Floats) -> Floats:
    """Return offsets (frames, persons, 17, 3) [m], world, from joints to the detector's joints.

    Args:
        joints: (frames, persons, 17, 3) [m], world.
        habits: the detector's systematic errors.
        noise: spreads.
        own: (persons, 17, 3) person-specific offsets [standard deviations].
    """
    front, left = facing(joints)
    up = np.broadcast_to([0.0, 0.0, 1.0], front.shape)
    offsets = noise.shared_bias * habits.joint_bias + noise.own_bias * own
    turned: Floats = offsets @ np.stack([front, left, up], axis=-2)
    return turned


def detect(
    sight: Sight,
    noise: ObservationNoise,
    habits: Habits,
    fps: float,
    rngs: list[np.random.Generator],
) -> Detections:
    """Return a detector's reports.

    Args:
        sight: true keypoints and occlusions in the image.
        noise: rates and spreads.
        habits: the detector's systematic errors.
        fps: [1/s].
        rngs: one per person; one person's draws never change another's errors.
    """
    shape = sight.hidden.shape
    keypoints, confidence = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
    displaced, merged = np.zeros(shape, dtype=bool), np.full(shape[:2], -1, dtype=np.int16)
    for person, rng in enumerate(rngs):
        if np.isfinite(sight.keypoints[:, person]).any():
            one = _detect_one(sight, person, noise, habits, fps, rng)
            keypoints[:, person], confidence[:, person] = one.keypoints, one.confidence
            displaced[:, person], merged[:, person] = one.displaced, one.merged_into
    return Detections(keypoints, confidence, displaced, merged)


def _detect_one(
    sight: Sight,
    person: int,
    noise: ObservationNoise,
    habits: Habits,
    fps: float,
    rng: np.random.Generator,
) -> Detections:
    pixels, size = sight.keypoints[:, person], sight.size[:, person]
    hider = sight.hider[:, person]
    hidden, frames = hider >= 0, len(pixels)
    small = size < noise.small
    spread = size[:, None] * DIFFICULTY

    error = _errors(pixels, spread, noise, fps, rng)
    error *= (1.0 + noise.hidden_spread * hidden)[..., None]
    far = np.linalg.norm(error, axis=-1) / size[:, None]
    doubt = 1.0 + noise.confidence_spread * rng.standard_normal((frames, 17))
    confidence = np.exp(-noise.confidence_drop * far) * doubt
    confidence = np.clip(confidence * (1.0 - noise.hidden_doubt * hidden), 0.01, 1.0)
    twice = 2.0 * sight.azimuth[:, person]
    waves = np.stack([np.cos(twice), np.sin(twice)], axis=-1)
    view = np.einsum("fw,jwa->fja", waves, habits.view_bias)
    error = error + sight.bias[:, person] + noise.view_bias * spread[..., None] * view

    thrown = rng.random((frames, 17)) < noise.displaced
    angle, reach = 2.0 * np.pi * rng.random((frames, 17)), rng.uniform(*DISPLACED, (frames, 17))
    sigma = np.hypot(np.hypot(noise.white, noise.slow) * spread, noise.floor)
    throw = (reach * sigma)[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    keypoints = pixels + error + np.where(thrown[..., None], throw, 0.0)

    stolen = bursts(noise.stolen, noise.stolen_time, (frames, 17), fps, rng) & hidden
    frame, joint = np.nonzero(stolen)
    theirs = sight.keypoints[frame, hider[frame, joint], joint]
    there = np.isfinite(theirs[:, 0])
    keypoints[frame[there], joint[there]] = theirs[there] + error[frame[there], joint[there]]

    luck = rng.random((frames, 17))
    lost = luck < np.where(hidden, noise.hidden_joint_missed, noise.joint_missed)
    missed = _bursts_by_size(noise.person_missed, noise.person_missed_time, small, fps, rng)
    overlapped = hidden.mean(axis=-1) >= MOSTLY_HIDDEN
    overlapped &= rng.random(frames) < noise.hidden_person_missed
    merges = overlapped & (rng.random(frames) < noise.merged)
    lost |= (missed | overlapped)[:, None]
    outside = np.isnan(pixels[..., 0])
    lost |= outside | ((~outside).sum(axis=-1) < noise.fewest_joints)[:, None]
    swapped = _bursts_by_size(noise.swapped, noise.swapped_time, small, fps, rng)
    for array in (keypoints, lost, confidence, thrown):
        array[swapped] = array[swapped][:, MIRRORED]
    keypoints[lost], confidence[lost] = np.nan, np.nan
    return Detections(
        keypoints, confidence, thrown & ~lost, np.where(merges, hider.max(axis=-1), -1)
    )


def _errors(
    pixels: Floats, spread: Floats, noise: ObservationNoise, fps: float, rng: np.random.Generator
) -> Floats:
    """Return errors of zero mean (frames, 17, 2) [px]: white, slow and by motion."""
    white = rng.standard_normal(pixels.shape)
    slow = drift(pixels.shape, noise.slow_time, fps, rng)
    along = rng.standard_normal((*spread.shape, 1))
    error: Floats = np.hypot(noise.white * spread, noise.floor)[..., None] * white
    error += (noise.slow * spread)[..., None] * slow
    if len(pixels) > 1 and noise.blur > 0.0:
        motion = np.gradient(pixels, axis=0) * fps
        # At the image border the motion is unknown; blur is negligible there.
        error += noise.blur * np.where(np.isfinite(motion), motion, 0.0) * along
    return error


def _bursts_by_size(
    share: float, time: float, small: Flags, fps: float, rng: np.random.Generator
) -> Flags:
    """Return bursts (frames,); small people have them from two sources."""
    both = bursts(share, time, (len(small), 2), fps, rng)
    on: Flags = both[:, 0] | (both[:, 1] & small)
    return on
