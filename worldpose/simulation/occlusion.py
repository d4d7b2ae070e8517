"""Projections of bodies into a camera's images, and occlusions between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from worldpose.geometry import Camera

TRUNK: Final = (5, 6, 11, 12)


@dataclass(frozen=True, eq=False)
class Bodies:
    """People, or false positives, in front of a camera.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where absent.
        heights: (persons,) [m].
        bias: (frames, persons, 17, 3) [m], world: from a joint to the detector's joint; None =
            zero.
    """

    joints: Floats
    heights: Floats
    bias: Floats | None = None


@dataclass(frozen=True, eq=False)
class Projections:
    """Projections of bodies into an image, and their occlusions.

    Attributes:
        keypoints: (frames, persons, 17, 2) [px]; NaN outside the image.
        bias: (frames, persons, 17, 2) [px], of `Bodies.bias`; 0 without.
        hider: (frames, persons, 17) int16, the nearest of the persons before a joint, -1 = none.
        size: (frames, persons) height of a standing person there [px].
        azimuth: (frames, persons) direction of the camera seen from the body [rad]: 0 in front,
            a quarter turn to the left.
    """

    keypoints: Floats
    bias: Floats
    hider: NDArray[np.int16]
    size: Floats
    azimuth: Floats

    @property
    def hidden(self) -> Flags:
        """Return the joints behind a nearer person (frames, persons, 17)."""
        hidden: Flags = self.hider >= 0
        return hidden

    @property
    def seen(self) -> Flags:
        """Return the joints in the image that are not occluded (frames, persons, 17)."""
        seen: Flags = np.isfinite(self.keypoints[..., 0]) & ~self.hidden
        return seen


def project_bodies(camera: Camera, bodies: Bodies) -> Projections:
    """Return the exact pixels of bodies, and the occlusions of joints by nearer bodies.

    A nearer body hides the contents of its box: from its highest to its lowest joint, as wide as
    its shoulders and hips with a third on either side.

    Args:
        camera: a single camera, or one for every frame.
        bodies: all people; every one may hide every other.
    """
    pixels = _project(camera, bodies.joints)
    bias = np.zeros(pixels.shape)
    if bodies.bias is not None:
        bias = _project(camera, bodies.joints + bodies.bias) - pixels
    inside = (pixels >= -0.5) & (pixels <= camera.image_size.reshape(-1, 1, 1, 2) - 0.5)
    middle = bodies.joints[..., TRUNK, :].mean(axis=-2)
    depth = camera.cam_from_world.apply(middle)[..., 2]
    focal = camera.focal.mean(axis=-1)[..., None]
    front, left = facing(bodies.joints)
    away = camera.center.reshape(-1, 1, 3) - middle
    return Projections(
        keypoints=np.where(np.all(inside, axis=-1, keepdims=True), pixels, np.nan),
        bias=bias,
        hider=_hiders(pixels, depth),
        size=focal * bodies.heights / np.where(depth > 0.0, depth, np.nan),
        azimuth=np.arctan2((away * left).sum(-1), (away * front).sum(-1)),
    )


def facing(joints: Floats) -> tuple[Floats, Floats]:
    """Return horizontal unit vectors (..., 3) to the front and left of bodies (..., 17, 3)."""
    left = joints[..., (5, 11), :].sum(axis=-2) - joints[..., (6, 12), :].sum(axis=-2)
    left[..., 2] = 0.0
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    return np.stack([left[..., 1], -left[..., 0], left[..., 2]], axis=-1), left


def _project(camera: Camera, joints: Floats) -> Floats:
    frames, persons = joints.shape[:2]
    return camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)


def _hiders(pixels: Floats, depth: Floats) -> NDArray[np.int16]:
    low, high = pixels.min(axis=2), pixels.max(axis=2)
    trunk = pixels[..., TRUNK, 0]
    third = (trunk.max(axis=2) - trunk.min(axis=2)) / 3.0
    low[..., 0], high[..., 0] = trunk.min(axis=2) - third, trunk.max(axis=2) + third
    hider = np.full(pixels.shape[:3], -1, dtype=np.int16)
    nearest = np.full(pixels.shape[:3], np.inf)
    reach_low, reach_high = pixels.min(axis=2), pixels.max(axis=2)
    for person in range(pixels.shape[1]):
        one_low, one_high = low[:, person, None], high[:, person, None]
        # Only the few bodies with overlapping extents need the test joint by joint.
        meets = np.all((reach_high >= one_low) & (reach_low <= one_high), axis=-1)
        frame, other = np.nonzero(meets & (depth[:, person, None] < depth))
        joints, before = pixels[frame, other], depth[frame, person, None]
        covered = (joints >= low[frame, person, None]) & (joints <= high[frame, person, None])
        hides = np.all(covered, axis=-1) & (before < nearest[frame, other])
        hider[frame, other] = np.where(hides, person, hider[frame, other])
        nearest[frame, other] = np.where(hides, before, nearest[frame, other])
    return hider
