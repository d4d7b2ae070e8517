"""Visibility of people in each camera: limbs as capsules that occlude points behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from worldpose.simulation.foreign.rigs import RigCamera

CAPSULES: Final = (
    *((5, 12, 0.06), (6, 11, 0.06), (5, 6, 0.04), (11, 12, 0.05)),
    *((5, 7, 0.028), (6, 8, 0.028), (7, 9, 0.024), (8, 10, 0.024)),
    *((11, 13, 0.045), (12, 14, 0.045), (13, 15, 0.03), (14, 16, 0.03), (3, 4, 0.055)),
)
"""Joint pairs of body parts, and their half widths [stature]."""
_TRUNK: Final = (5, 6, 11, 12)


@dataclass(frozen=True, eq=False)
class View:
    """People in one camera's image.

    Attributes:
        pixels: (frames, persons, 17, 2) [px]; NaN behind the camera.
        inside: (frames, persons, 17) in the image and not behind a pillar.
        hider: (frames, persons, 17) int16, the person in front of a joint, -1 for none.
        behind_self: (frames, persons, 17) behind the person's own trunk.
        size: (frames, persons) height of a standing person there [px].
        azimuth, elevation: (frames, persons) direction of the camera, seen from the body [rad]: 0
            in front, growing to the left; 0 level, growing upwards.
        scale: (frames, persons) pixels per metre there [px/m].
    """

    pixels: Floats
    inside: Flags
    hider: NDArray[np.int16]
    behind_self: Flags
    size: Floats
    azimuth: Floats
    elevation: Floats
    scale: Floats

    @property
    def seen(self) -> Flags:
        """Return the joints (frames, persons, 17) in the image that no other person occludes."""
        return np.asarray(self.inside & (self.hider < 0))


def view_people(
    camera: RigCamera, joints: Floats, statures: Floats, pillar: tuple[float, float] | None
) -> View:
    """Return positions of people in the image and their occlusions.

    Args:
        camera: true camera.
        joints: (frames, persons, 17, 3) [m], world.
        statures: (persons,) [m].
        pillar: left and right border of an occluded strip [px], or None.
    """
    pixels = camera.project(joints)
    inside = camera.sees(pixels)
    if pillar is not None:
        with np.errstate(invalid="ignore"):
            inside &= (pixels[..., 0] < pillar[0]) | (pixels[..., 0] > pillar[1])
    trunk = joints[:, :, _TRUNK].mean(axis=2)
    depth = camera.camera.cam_from_world.apply(trunk)[..., 2]
    scale = float(camera.camera.focal.mean()) / np.where(depth > 0.1, depth, np.nan)
    away = camera.camera.center - trunk
    forward, left = facing(joints)
    level = np.linalg.norm(away[..., :2], axis=-1)
    return View(
        pixels=pixels,
        inside=inside,
        hider=_find_hiders(pixels, depth, scale * statures),
        behind_self=_is_behind_trunk(camera, joints, pixels, depth, scale * statures),
        size=scale * statures,
        azimuth=np.arctan2((away * left).sum(-1), (away * forward).sum(-1)),
        elevation=np.arctan2(away[..., 2], level),
        scale=scale,
    )


def facing(joints: Floats) -> tuple[Floats, Floats]:
    """Return horizontal unit vectors (..., 3) forward and to the left of bodies (..., 17, 3)."""
    across = joints[..., 5, :] - joints[..., 6, :] + joints[..., 11, :] - joints[..., 12, :]
    across = across * [1.0, 1.0, 0.0]
    left = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([left[..., 1], -left[..., 0], 0.0 * left[..., 0]], axis=-1), left


def _find_hiders(pixels: Floats, depth: Floats, size: Floats) -> NDArray[np.int16]:
    persons = depth.shape[1]
    hider = np.full(pixels.shape[:3], -1, np.int16)
    nearest = np.full(pixels.shape[:3], np.inf)
    low, high = pixels.min(axis=2), pixels.max(axis=2)
    room = 0.06 * size[..., None]
    for person in range(persons):
        with np.errstate(invalid="ignore"):
            meets = np.all(
                (high >= low[:, [person]] - room[:, [person]])
                & (low <= high[:, [person]] + room[:, [person]]),
                axis=-1,
            )
            meets &= depth[:, [person]] < depth - 0.15
        frame, other = np.nonzero(meets)
        if not len(frame):
            continue
        covered = _is_covered(pixels[frame, other], pixels[frame, person], size[frame, person])
        before = depth[frame, person][:, None]
        closer = covered & (before < nearest[frame, other])
        hider[frame, other] = np.where(closer, person, hider[frame, other])
        nearest[frame, other] = np.where(closer, before, nearest[frame, other])
    return hider


def _is_covered(points: Floats, body: Floats, size: Floats) -> Flags:
    """Return which points (rows, joints, 2) a body (rows, 17, 2) of a size (rows,) [px] covers."""
    covered = np.zeros(points.shape[:2], np.bool_)
    for one, two, width in CAPSULES:
        begin, line = body[:, [one]], body[:, [two]] - body[:, [one]]
        length = np.maximum((line**2).sum(-1), 1e-9)
        share = np.clip(((points - begin) * line).sum(-1) / length, 0.0, 1.0)
        away = np.linalg.norm(points - begin - share[..., None] * line, axis=-1)
        covered |= away < width * size[:, None]
    return covered


def _is_behind_trunk(
    camera: RigCamera, joints: Floats, pixels: Floats, depth: Floats, size: Floats
) -> Flags:
    """Return joints (frames, persons, 17) over half a trunk's depth behind the own trunk."""
    frames, persons = depth.shape
    own = camera.camera.cam_from_world.apply(joints.reshape(-1, 3))[:, 2].reshape(pixels.shape[:3])
    behind = own > depth[..., None] + 0.09
    flat = pixels.reshape(-1, 17, 2)
    covered = np.zeros((frames * persons, 17), np.bool_)
    for one, two, width in CAPSULES[:4]:
        begin, line = flat[:, [one]], flat[:, [two]] - flat[:, [one]]
        length = np.maximum((line**2).sum(-1), 1e-9)
        share = np.clip(((flat - begin) * line).sum(-1) / length, 0.0, 1.0)
        away = np.linalg.norm(flat - begin - share[..., None] * line, axis=-1)
        covered |= away < width * size.reshape(-1, 1)
    return np.asarray(covered.reshape(frames, persons, 17) & behind)
