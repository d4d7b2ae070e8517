"""Monocular bodies of one camera, rotated into the world and assigned to tracks (S4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats
from worldpose.body_fitting.monocular import MonocularEstimates
from worldpose.body_fitting.pose_space import GATHER
from worldpose.body_fitting.starting import bridged
from worldpose.geometry import Camera, Rigid

GATE: Final = 0.35
"""Maximum image distance between an estimate and its person [person height]."""


@dataclass(frozen=True, eq=False)
class MonocularPoses:
    """Poses of people, estimated from images of one camera."""

    orient: Floats
    """(frames, persons, 3, 3), world from body; NaN without an estimate."""
    angles: Floats
    """(frames, persons, 30) [rad], of `pose_space`; NaN without an estimate."""


def place_monocular_poses(
    estimates: MonocularEstimates, camera: Camera, frame: NDArray[np.int64], joints: Floats
) -> MonocularPoses:
    """Return the estimates of tracked people, in the world.

    A method that sees a crop treats its center as straight ahead; the calibrated camera has a ray
    there, and rotating the optical axis onto it rotates the body, by 10 degrees near the border of
    a broadcast image. The assignment minimizes the distances to the middle of the projected joints,
    frame by frame.

    Args:
        estimates: in images of the camera.
        camera: batch (frames,).
        frame: (frames,), frame numbers.
        joints: (frames, persons, 17, 3) [m], world; gaps are interpolated.
    """
    frames, persons = joints.shape[:2]
    orient = np.full((frames, persons, 3, 3), np.nan)
    angles = np.full((frames, persons, GATHER.shape[0]), np.nan)
    if not persons:
        return MonocularPoses(orient, angles)
    full = np.stack([bridged(joints[:, person]) for person in range(persons)], axis=1)
    image = camera.project(full.reshape(frames, -1, 3)).reshape(frames, persons, -1, 2)
    known = np.isfinite(image)
    low = np.where(known, image, np.inf).min(axis=2, initial=np.inf)
    high = np.where(known, image, -np.inf).max(axis=2, initial=-np.inf)
    middle, height = 0.5 * (low + high), high[..., 1] - low[..., 1]
    for place in np.flatnonzero(np.isin(frame, estimates.frame)):
        rows = np.flatnonzero(estimates.frame == frame[place])
        with np.errstate(invalid="ignore", divide="ignore"):
            away = np.linalg.norm(estimates.center[rows, None] - middle[place], axis=-1)
            away = away / height[place]
        away = np.where(np.isfinite(away), away, np.inf)
        row, person = linear_sum_assignment(np.minimum(away, GATE))
        near = away[row, person] < GATE
        row, person = rows[row[near]], person[near]
        at = camera[int(place)]
        turned = estimates.rotations[row, 0]
        if estimates.cropped:
            turned = _towards(at.normalize(estimates.center[row])) @ turned
        orient[place, person] = at.cam_from_world.rotation.T @ turned
        turns = Rigid(estimates.rotations[row, 1:], np.zeros(3)).rotvec
        angles[place, person] = turns.reshape(len(row), GATHER.shape[1]) @ GATHER.T
    bad = ~(np.isfinite(orient).all((-1, -2)) & np.isfinite(angles).all(-1))
    orient[bad], angles[bad] = np.nan, np.nan
    return MonocularPoses(orient, angles)


def _towards(plane: Floats) -> Floats:
    """Return the smallest rotations (n, 3, 3) from straight ahead to points (n, 2) at z = 1."""
    ahead = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    across = np.cross([0.0, 0.0, 1.0], ahead)
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.arctan2(sine, ahead[:, 2:])
    return Rigid.from_rotvec(across / np.maximum(sine, 1e-12) * angle, np.zeros(3)).rotation
