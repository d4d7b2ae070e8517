"""Occlusions of joints by the bodies of nearer people, in images."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17_TORSO
from worldpose.geometry.cameras import Camera

Capsules = tuple[tuple[int, int, float], ...]
CAPSULES: Final[Capsules] = (
    *((5, 12, 0.06), (6, 11, 0.06), (5, 6, 0.04), (11, 12, 0.05)),
    *((5, 7, 0.028), (6, 8, 0.028), (7, 9, 0.024), (8, 10, 0.024)),
    *((11, 13, 0.045), (12, 14, 0.045), (13, 15, 0.03), (14, 16, 0.03), (3, 4, 0.055)),
)
"""Joint pairs of body parts, and their half widths [stature]."""


def facing_axes(joints: Floats) -> tuple[Floats, Floats]:
    """Return horizontal unit vectors (..., 3) forward and to the left of bodies (..., 17, 3)."""
    across = joints[..., 5, :] - joints[..., 6, :] + joints[..., 11, :] - joints[..., 12, :]
    across = across * [1.0, 1.0, 0.0]
    left = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([left[..., 1], -left[..., 0], 0.0 * left[..., 0]], axis=-1), left


def find_hiders(pixels: Floats, depth: Floats, size: Floats) -> NDArray[np.int16]:
    """Return the nearest of the persons before a joint (frames, persons, joints), -1 for none.

    Pixels (frames, persons, joints, 2) begin with COCO-17; depth (frames, persons) [m] is of
    trunks, size (frames, persons) [px] the height of a standing person there.
    """
    persons = depth.shape[1]
    hider = np.full(pixels.shape[:3], -1, np.int16)
    nearest = np.full(pixels.shape[:3], np.inf)
    low, high = np.fmin.reduce(pixels, axis=2), np.fmax.reduce(pixels, axis=2)
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
        covered = is_covered(pixels[frame, other], pixels[frame, person], size[frame, person])
        before = depth[frame, person][:, None]
        closer = covered & (before < nearest[frame, other])
        hider[frame, other] = np.where(closer, person, hider[frame, other])
        nearest[frame, other] = np.where(closer, before, nearest[frame, other])
    return hider


def is_covered(points: Floats, body: Floats, size: Floats, parts: Capsules = CAPSULES) -> Flags:
    """Return which points (rows, joints, 2) a body (rows, 17, 2) of a size (rows,) [px] covers."""
    covered = np.zeros(points.shape[:2], np.bool_)
    for one, two, width in parts:
        begin, line = body[:, [one]], body[:, [two]] - body[:, [one]]
        length = np.maximum((line**2).sum(-1), 1e-9)
        share = np.clip(((points - begin) * line).sum(-1) / length, 0.0, 1.0)
        away = np.linalg.norm(points - begin - share[..., None] * line, axis=-1)
        covered |= away < width * size[:, None]
    return covered


def hidden_joints(joints: Floats, camera: Camera) -> Flags:
    """Return which joints a nearer person hides (frames, persons, joints).

    Joints (frames, persons, joints, 3) [m], world, begin with COCO-17, NaN where missing. The
    camera is one, or (frames,), NaN where a frame has none.
    """
    stature = 1.8  # mean height of a person [m]
    frames, persons, count, _ = joints.shape
    pixels = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, count, 2)
    trunk = joints[:, :, COCO17_TORSO]
    known = np.isfinite(trunk).all(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):  # who has no trunk neither hides nor is hidden
        middle = np.where(known, trunk, 0.0).sum(axis=2) / known.sum(axis=2)
        depth = np.linalg.norm(middle - camera.center[..., None, :], axis=-1)
        size = stature * camera.focal.mean(axis=-1)[..., None] / depth
        return find_hiders(pixels, depth, size) >= 0


def visible_shares(joints: Floats, camera: Camera) -> Floats:
    """Return the share of joints in the image that no other hides (frames, persons) [0..1].

    Joints are (frames, persons, 17, 3) [m], world; NaN where a person, or the camera, is missing.
    """
    frames, persons, count, _ = joints.shape
    pixels = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, count, 2)
    within = (pixels >= -0.5) & (pixels <= camera.image_size[..., None, None, :] - 0.5)
    seen = within.all(-1) & ~hidden_joints(joints, camera)
    placed = np.asarray(np.isfinite(camera.center).all(axis=-1))
    known = np.isfinite(joints).all((-1, -2)) & placed[..., None]
    return np.where(known, seen.mean(-1), np.nan)
