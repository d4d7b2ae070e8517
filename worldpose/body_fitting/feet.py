"""Feet on the ground: standing ankles, and the orientation of feet without keypoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body import BodyModel
from worldpose.body_fitting.settings import BodyFittingSettings

Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""

ANKLES: Final = (15, 16)
"""Of COCO-17."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Standing feet of one person, and the height of a standing ankle."""

    standing: Floats
    """(frames, 2) 1 where an ankle stands, else 0."""
    slipping: Floats
    """(frames - 1, 2) 1 where it stands in this and the next frame."""
    height: Floats
    """(frames, 2) [m], world: a flat foot's ankle there, the minimum of any ankle."""

    def of(self, seen: NDArray[np.bool_]) -> Contacts:
        """Return the contacts of seen ankles (frames, 17); unseen ankles may stand or not."""
        ankles = seen[:, ANKLES]
        both = ankles[1:] & ankles[:-1]
        return Contacts(self.standing * ankles, self.slipping * both, self.height)


def find_contacts(
    joints: Floats, ankle_height: float, ground: Ground, fps: float, settings: BodyFittingSettings
) -> Contacts:
    """Return contacts of ankles that are low and slow for at least two frames.

    Args:
        joints: (frames, 17, 3) [m], world, of a fit.
        ankle_height: of this person's ankle above the sole [m].
        ground: the surface.
        fps: [1/s].
        settings: limits of low and slow.
    """
    ankles = joints[:, ANKLES]
    height = ground(ankles[..., 0], ankles[..., 1]) + ankle_height
    if len(joints) < 2:
        return Contacts(np.zeros(height.shape), np.zeros((0, 2)), height)
    speed = np.linalg.norm(np.diff(ankles, axis=0), axis=-1) * fps
    low = ankles[..., 2] - height < settings.contact_height
    slipping = (speed < settings.contact_speed) & low[1:] & low[:-1]
    standing = np.zeros(low.shape, dtype=bool)
    standing[1:] |= slipping
    standing[:-1] |= slipping
    return Contacts(standing.astype(np.float64), slipping.astype(np.float64), height)


def ankle_height(model: BodyModel, betas: Floats) -> float:
    """Return the height of the ankles of an upright body above its soles [m]."""
    lowest = int(model.template[:, 1].argmin())
    sole = model.template[lowest, 1] + model.shape_directions[lowest, 1] @ betas
    joints = model.joint_template + model.joint_directions @ betas
    return float(joints[7:9, 1].mean() - sole)


def level_feet(rotations: Floats, clear: Floats) -> Floats:
    """Return rotations of feet relative to their shanks (frames, 3, 3): flat where they stand.

    Args:
        rotations: (frames, 3, 3) of the shank, world.
        clear: (frames,) [m], height of the ankle above that of a flat foot; a foot 0.15 m up or on
            a horizontal shank hangs as in the unposed body.
    """
    forward = rotations[..., 2].copy()
    forward[..., 2] = 0.0
    length = np.linalg.norm(forward, axis=-1, keepdims=True)
    forward /= np.maximum(length, 1e-9)
    up = np.broadcast_to([0.0, 0.0, 1.0], forward.shape)
    flat = np.stack([np.cross(up, forward), up, forward], axis=-1)
    upright = np.clip((rotations[:, 2, 1] - 0.25) / 0.35, 0.0, 1.0)
    share = upright * np.clip(1.0 - clear / 0.15, 0.0, 1.0) * (length[:, 0] > 0.1)
    mixed = share[:, None, None] * flat + (1.0 - share)[:, None, None] * rotations
    u, _, vt = np.linalg.svd(mixed)
    turned: Floats = rotations.swapaxes(-1, -2) @ u @ vt
    return turned
