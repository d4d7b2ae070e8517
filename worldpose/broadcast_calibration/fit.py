"""Reprojection residuals of markings and people in a moving camera."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.evidence import MARKING, PLAYER, PointEvidence
from worldpose.broadcast_calibration.moving_camera import MovingCamera


def pixels_off(camera: MovingCamera, points: PointEvidence) -> Floats:
    """Return projected minus observed pixels (n, 2); infinite where there is no projection."""
    off = np.full((len(points), 2), np.inf)
    for frame in np.unique(points.frame):
        mine = np.flatnonzero(points.frame == frame)
        single = camera.frames(slice(int(frame), int(frame) + 1)).camera[0]
        off[mine] = single.project(points.world[mine]) - points.image[mine]
    return np.where(np.isfinite(off), off, np.inf)


def misses(camera: MovingCamera, points: PointEvidence) -> tuple[float, float]:
    """Return the median residuals of markings and of people [px]; NaN without any.

    Residuals of painted lines are distances across them, of inliers. Residuals of people are means
    over a person's keypoints per frame, which average out keypoint errors but not camera errors.

    Args:
        camera: all frames.
        points: the evidence.
    """
    off = pixels_off(camera, points)
    lines = points.kind == MARKING
    with np.errstate(invalid="ignore"):
        white = np.abs(np.einsum("nj,nj->n", points.whitening[lines, 0], off[lines]))
    across = white / np.linalg.norm(points.whitening[lines, 0], axis=-1)
    across = across[white < points.loss[lines]]
    people = np.flatnonzero((points.kind == PLAYER) & np.isfinite(off).all(axis=-1))
    # Keypoints with gross errors say nothing about the camera.
    far = np.linalg.norm(off[people] * points.whitening[people][:, [0, 1], [0, 1]], axis=-1)
    people = people[far < 2.0 * points.loss[people]]
    key = np.column_stack([points.frame[people], points.source[people]])
    _, person, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(person.ravel(), off[people, axis]) for axis in range(2)], axis=-1)
    beside = np.linalg.norm(sums[: len(count)] / count[:, None], axis=-1)
    return (
        float(np.median(across)) if len(across) else float("nan"),
        float(np.median(beside)) if len(beside) else float("nan"),
    )
