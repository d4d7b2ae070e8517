"""What one camera's detector reports about people whose joints are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17, COCO17_SIGMAS
from worldpose.cameras import Camera
from worldpose.ingest import Observations
from worldpose.synthetic.noise import ObservationNoise, bursts, drift

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

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
"""Share of hidden joints from which on a person is mostly hidden."""
TRUNK: Final = (5, 6, 11, 12)


@dataclass(frozen=True, eq=False)
class Bodies:
    """People, or false ones, in front of a camera.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where absent.
        heights: (persons,) [m].
    """

    joints: Floats
    heights: Floats


@dataclass(frozen=True, eq=False)
class Sight:
    """Where bodies are in a picture and what hides them.

    Attributes:
        keypoints: (frames, persons, 17, 2) [px]; NaN outside the picture.
        hidden: (frames, persons, 17), behind a nearer person.
        size: (frames, persons) height of a standing person there [px].
    """

    keypoints: Floats
    hidden: Flags
    size: Floats

    @property
    def seen(self) -> Flags:
        """Joints in the picture that nothing hides (frames, persons, 17)."""
        seen: Flags = np.isfinite(self.keypoints[..., 0]) & ~self.hidden
        return seen


def see(camera: Camera, bodies: Bodies) -> Sight:
    """Return the exact pixels of bodies, and which joints a nearer body hides.

    A nearer body hides what lies in its box: from its highest to its lowest joint, as wide as its
    shoulders and hips with a third on either side.

    Args:
        camera: a single camera.
        bodies: all people; every one may hide every other.
    """
    frames, persons = bodies.joints.shape[:2]
    points = bodies.joints.reshape(-1, 3)
    pixels = camera.project(points).reshape(frames, persons, 17, 2)
    width, height = camera.image_size
    within = (pixels >= -0.5) & (pixels <= np.array([width, height]) - 0.5)
    inside = np.all(within, axis=-1, keepdims=True)
    middle = bodies.joints[..., TRUNK, :].mean(axis=-2)
    depth = camera.cam_from_world.apply(middle.reshape(-1, 3))[:, 2].reshape(frames, persons)
    low, high = pixels.min(axis=2), pixels.max(axis=2)
    trunk = pixels[..., TRUNK, 0]
    third = (trunk.max(axis=2) - trunk.min(axis=2)) / 3.0
    low[..., 0], high[..., 0] = trunk.min(axis=2) - third, trunk.max(axis=2) + third
    hidden = np.zeros((frames, persons, 17), dtype=np.bool_)
    for nearer in range(persons):
        covered = (pixels >= low[:, nearer, None, None]) & (pixels <= high[:, nearer, None, None])
        hidden |= np.all(covered, axis=-1) & (depth[:, nearer, None] < depth)[..., None]
    return Sight(
        keypoints=np.where(inside, pixels, np.nan),
        hidden=hidden,
        size=camera.focal.mean() * bodies.heights / np.where(depth > 0.0, depth, np.nan),
    )


def detect(
    sight: Sight, noise: ObservationNoise, fps: float, rngs: list[np.random.Generator]
) -> tuple[Floats, Floats]:
    """Return keypoints (frames, persons, 17, 2) [px] and confidences as a detector has them.

    Args:
        sight: the truth in the picture.
        noise: rates and spreads.
        fps: [1/s].
        rngs: one a person; what one person draws never changes another's errors.
    """
    keypoints = np.full(sight.keypoints.shape, np.nan)
    confidence = np.full(sight.hidden.shape, np.nan)
    for person, rng in enumerate(rngs):
        one = (sight.keypoints[:, person], sight.hidden[:, person], sight.size[:, person])
        keypoints[:, person], confidence[:, person] = _detect_one(*one, noise, fps, rng)
    return keypoints, confidence


def _detect_one(
    pixels: Floats,
    hidden: Flags,
    size: Floats,
    noise: ObservationNoise,
    fps: float,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    frames = len(pixels)
    white = rng.standard_normal(pixels.shape)
    slow = drift(pixels.shape, noise.slow_time, fps, rng)
    luck = rng.random((frames, 17))
    doubt = rng.standard_normal((frames, 17))
    hidden_luck = rng.random(frames)
    missed = bursts(noise.person_missed, noise.person_missed_time, (frames,), fps, rng)
    swapped = bursts(noise.swapped, noise.swapped_time, (frames,), fps, rng)

    spread = size[:, None] * DIFFICULTY
    error = (
        np.hypot(noise.white * spread, noise.floor)[..., None] * white
        + (noise.slow * spread)[..., None] * slow
    ) * (1.0 + noise.hidden_spread * hidden)[..., None]
    keypoints = pixels + error
    far = np.linalg.norm(error, axis=-1) / size[:, None]
    confidence = np.exp(-noise.confidence_drop * far) * (1.0 + noise.confidence_spread * doubt)
    confidence = np.clip(confidence * (1.0 - noise.hidden_doubt * hidden), 0.01, 1.0)

    lost = luck < np.where(hidden, noise.hidden_joint_missed, noise.joint_missed)
    mostly_hidden = hidden.mean(axis=-1) >= MOSTLY_HIDDEN
    lost |= (missed | (mostly_hidden & (hidden_luck < noise.hidden_person_missed)))[:, None]
    outside = np.isnan(pixels[..., 0])
    lost |= outside | ((~outside).sum(axis=-1) < noise.fewest_joints)[:, None]
    keypoints[swapped], lost[swapped] = keypoints[swapped][:, MIRRORED], lost[swapped][:, MIRRORED]
    confidence[swapped] = confidence[swapped][:, MIRRORED]
    keypoints[lost], confidence[lost] = np.nan, np.nan
    return keypoints, confidence


def report(
    first_frame: int, keypoints: Floats, confidence: Floats, size: Floats, rng: np.random.Generator
) -> tuple[Observations, NDArray[np.int16]]:
    """Return detections in an order that tells nothing, and which body each one is.

    Args:
        first_frame: number of the first frame.
        keypoints: (frames, bodies, 17, 2) [px].
        confidence: (frames, bodies, 17).
        size: (frames, bodies) [px]; gives the boxes room for head, hands and feet.
        rng: shuffles every frame anew.

    Returns:
        Observations, and the body of every detection (frames, detections), -1 for padding.
    """
    found = np.isfinite(confidence).any(-1)
    order = np.argsort(np.where(found, rng.random(found.shape), np.inf), axis=1)
    order = order[:, : int(found.sum(axis=1).max(initial=0))]
    found = np.take_along_axis(found, order, axis=1)
    keypoints = np.take_along_axis(keypoints, order[..., None, None], axis=1)
    confidence = np.take_along_axis(confidence, order[..., None], axis=1)
    room = 0.06 * np.take_along_axis(size, order, axis=1)[..., None]
    # Padding has neither box nor score: a detection without keypoints never gets that far.
    everywhere = np.where(np.isnan(keypoints), np.inf, keypoints)
    low = np.where(found[..., None], everywhere.min(axis=2) - room, np.nan)
    everywhere = np.where(np.isnan(keypoints), -np.inf, keypoints)
    high = np.where(found[..., None], everywhere.max(axis=2) + room, np.nan)
    joints = np.maximum(np.isfinite(confidence).sum(-1), 1)
    score = np.where(found, np.nansum(confidence, axis=-1) / joints, np.nan)
    observations = Observations(
        frame=np.arange(first_frame, first_frame + len(found), dtype=np.int64),
        keypoints=keypoints.astype(np.float32),
        confidence=confidence.astype(np.float32),
        boxes=np.concatenate([low, high], axis=-1).astype(np.float32),
        score=score.astype(np.float32),
    )
    return observations, np.where(found, order, -1).astype(np.int16)
