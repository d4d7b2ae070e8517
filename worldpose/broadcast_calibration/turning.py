"""Rotation and zoom of the camera between two frames, from followed points (M2, M6)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.flow_equations import add_flow, flow_row
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.optical_flow import Followed
from worldpose.compiled import compiled

_SCALES: Final = (20.0, 5.0, 1.5, 0.6, 0.6)
"""Decreasing scales of the loss [px]."""
_LENS: Final = np.array([1.6, 1.0, 1.0])
"""Powers of the focal length that k1, k2 and k3 of a zoom lens grow with."""
_FEW: Final = 8
"""Minimum points for rotation and zoom [1]."""


@dataclass(frozen=True, eq=False)
class Turned:
    """The camera of the second of two frames.

    Attributes:
        camera: two frames: the given one, and the next.
        residual: (n, 2) of the followed points, predicted minus observed [px]; NaN where there is
            no prediction.
        determined: whether the points determine the motion.
    """

    camera: MovingCamera
    residual: Floats
    determined: bool


def turn(camera: MovingCamera, followed: Followed) -> Turned:
    """Return the next frame's rotation, zoom and lens from one frame's camera.

    Args:
        camera: a single frame.
        followed: its points in the next frame.
    """
    both = replace(
        camera,
        rotation=np.repeat(camera.rotation, 2, axis=0),
        focal=np.repeat(camera.focal, 2),
        distortion=np.repeat(camera.distortion, 2, axis=0),
    )
    return _fitted(both, followed, 4)


def turn_only(both: MovingCamera, followed: Followed) -> Turned:
    """Return the second of two frames with a fitted rotation and its given lens.

    Args:
        both: two frames; the second's rotation is ignored.
        followed: points of the first in the second.
    """
    both = replace(both, rotation=np.repeat(both.rotation[:1], 2, axis=0))
    return _fitted(both, followed, 3)


def flow_residuals(both: MovingCamera, followed: Followed) -> Floats:
    """Return predicted minus observed pixels of followed points (n, 2)."""
    residual = np.full((len(followed.start), 2), np.nan)
    _residuals(
        both.principal_point,
        both.focal,
        both.rotation,
        both.distortion,
        followed.start,
        followed.end,
        residual,
    )
    return residual


def modified_z_scores(residual: Floats) -> Floats:
    """Return each point's modified z-score (n,), the larger of both axes (M6).

    0.6745 times the distance from the median over the median of these distances (Iglewicz and
    Hoaglin, 1993); NaN where the residual is missing.

    Args:
        residual: (n, 2) [px].
    """
    if not np.isfinite(residual).any():
        return np.full(len(residual), np.nan)
    off = np.abs(residual - np.nanmedian(residual, axis=0))
    spread = np.maximum(np.nanmedian(off, axis=0), 1e-6)
    return np.asarray((0.6745 * off / spread).max(axis=-1))


def _fitted(both: MovingCamera, followed: Followed, count: int) -> Turned:
    """Return the second of two frames with fitted rotation and, if `count` is 4, zoom."""
    if len(followed.start) < _FEW:
        return Turned(both, np.full((len(followed.start), 2), np.nan), False)
    bounds = np.array([0, len(followed.start), len(followed.start)])
    ones = np.ones(len(followed.start))
    # The median motion is a robust start.
    x, y = np.median(followed.end - followed.start, axis=0) / float(both.focal[0])
    both = _moved(both, np.array([-y, x, 0.0, 0.0])[:count])
    for scale in _SCALES:
        blocks, right = np.zeros((3, 2, 7, 7)), np.zeros((2, 7))
        border, corner, rest = np.zeros((2, 7, 5)), np.zeros((5, 5)), np.zeros(5)
        add_flow(
            both.principal_point,
            both.focal,
            both.rotation,
            both.distortion,
            bounds,
            followed.start,
            followed.end,
            scale * ones,
            1.0,
            1.0,
            blocks,
            border,
            corner,
            right,
            rest,
        )
        normal = blocks[0, 1, :count, :count]
        normal = normal + 1e-9 * np.diag(np.diag(normal))
        if not np.linalg.cond(normal) < 1e12:
            return Turned(both, flow_residuals(both, followed), False)
        both = _moved(both, np.asarray(-np.linalg.solve(normal, right[1, :count])))
    return Turned(both, flow_residuals(both, followed), True)


def _moved(both: MovingCamera, step: Floats) -> MovingCamera:
    """Return both frames after a step of the second: rotation (3,), or with log focal (4,)."""
    whole = np.zeros((2, 7))
    whole[1, : len(step)] = step
    moved = both.stepped(whole, np.zeros(5))
    if len(step) == 3:
        return moved
    growth = (moved.focal[1] / moved.focal[0]) ** _LENS
    lens = np.stack([both.distortion[0], both.distortion[0] * growth])
    return replace(moved, distortion=lens)


@compiled
def _residuals(
    principal: Floats,
    focal: Floats,
    rotation: Floats,
    distortion: Floats,
    start: Floats,
    end: Floats,
    residual: Floats,
) -> None:
    """Write residuals (n, 2) of followed points; rows without a prediction stay unchanged."""
    pixel, rows = np.empty(2), np.empty((2, 16))
    for i in range(len(start)):
        if flow_row(principal, focal, rotation, distortion, start[i], pixel, rows):
            residual[i, 0] = pixel[0] - end[i, 0]
            residual[i, 1] = pixel[1] - end[i, 1]
