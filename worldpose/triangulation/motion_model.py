"""Typical accelerations of joints, and the correlation time of detector errors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.geometry import projection
from worldpose.triangulation.observations import PersonTrack, Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.track_solver import (
    TrackCosts,
    held_out_cost,
    prepare_tiles,
    solve_segment,
)

ACCELERATIONS: Final = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
"""Candidates [m/s^2]: from a stroller's trunk to a kicking foot."""
USUAL: Final = 25.0
"""Default without data [m/s^2]."""
WINDOWS: Final = 12
"""Intervals of tracks in the sample."""
WINDOW: Final = 2.0
"""Length of an interval [s]."""
REPEAT: Final = 0.2
"""Time over which errors may be correlated [s]: the averaging time of smoothing."""


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Motion prior of smoothing.

    Attributes:
        acceleration: (joints,) standard deviation per axis [m/s^2].
        repeated: frames whose errors count as one, at least 1.
    """

    acceleration: Floats
    repeated: float


def learn_motion(
    rig: Rig,
    tracks: Iterable[PersonTrack],
    joints: int,
    fps: float,
    settings: TriangulationSettings,
) -> MotionModel:
    """Return the accelerations that predict held-out cameras best.

    Joints are smoothed from every other camera and compared with the observations of the held-out
    cameras. This penalizes too much smoothing as well as too little. Errors that a detector repeats
    from frame to frame differ between cameras, so they do not count as motion. Left and right share
    one value.

    Args:
        rig: the cameras.
        tracks: intervals of one person each.
        joints: number of joints per person.
        fps: frames per second [1/s].
        settings: noise and inlier limit.
    """
    names = [name.split("_")[-1] for name in COCO17]
    limit, noise = settings.max_deviation**2, settings.noise
    kind = np.unique(names, return_inverse=True)[1] if joints == len(COCO17) else np.arange(joints)
    cost = np.zeros((len(ACCELERATIONS), joints))
    lag = max(1, round(REPEAT * fps))
    correlation, energy = np.zeros(lag + 1), 0.0
    odd = np.arange(len(rig.cameras)) % 2 == 1
    for track in tracks:
        pixels, weights, points = track.pixels, track.precision, track.joints
        for joint in range(joints):
            given = np.ascontiguousarray(points[:, joint])
            if not np.isfinite(given).all():
                continue
            for left_out in (odd, ~odd):
                seen = np.where(left_out[:, None], 0.0, weights[joint])
                hidden = np.where(left_out[:, None], weights[joint], 0.0)
                if ((seen > 0.0).sum(axis=0) < settings.min_views).any():
                    continue
                tiles = prepare_tiles(pixels[joint], hidden, rig)
                for n, acceleration in enumerate(ACCELERATIONS):
                    costs = TrackCosts(noise, limit, (fps**2 / acceleration) ** 2)
                    x, _ = solve_segment(pixels[joint], seen, given, rig, costs)
                    cost[n, joint] += held_out_cost(tiles, rig.depths, noise, limit, x)
            error = _whitened(pixels[joint], weights[joint], given, rig, noise, limit)
            energy += float(np.nansum(error * error))
            for k in range(1, lag + 1):
                correlation[k] += float(np.nansum(error[:, k:] * error[:, :-k]))
    total = np.stack([np.bincount(kind, row) for row in cost])[:, kind]
    best = np.array(ACCELERATIONS)[total.argmin(axis=0)]
    best = np.where(total.max(axis=0) > 0.0, best, USUAL)
    alike = np.maximum(correlation[1:] / energy, 0.0) if energy > 0.0 else np.zeros(lag)
    return MotionModel(best, float(1.0 + 2.0 * alike.sum()))


def choose_stretches(there: NDArray[np.bool_], fps: float) -> list[tuple[int, slice]]:
    """Return persons and intervals of frames to learn from, spread over the clip.

    Args:
        there: (frames, persons), whether the person can be triangulated.
        fps: frames per second [1/s].
    """
    frames, persons = there.shape
    length = max(1, min(frames, round(WINDOW * fps)))
    every = [
        (person, slice(start, start + length))
        for start in range(0, max(1, frames - length + 1), length)
        for person in range(persons)
        if 2 * there[start : start + length, person].sum() > length
    ]
    chosen = np.linspace(0, len(every) - 1, min(len(every), WINDOWS)).astype(int)
    return [every[n] for n in np.unique(chosen)]


def _whitened(
    pixels: Floats,
    weights: Floats,
    points: Floats,
    rig: Rig,
    noise: tuple[float, float],
    limit: float,
) -> Floats:
    """Return errors (cameras, frames, 2) in standard deviations; NaN for outlier views."""
    image = np.empty(pixels.shape)
    at = np.ascontiguousarray(np.broadcast_to(points, (*image.shape[:2], 3)))
    projection.project(rig.cameras, at, image)
    depth = at @ rig.depths[:, :3, None] + rig.depths[:, 3, None, None]
    size = rig.cameras[:, 0, None, None] / depth
    variance = noise[0] ** 2 + (size * noise[1]) ** 2
    usable = weights > 0.0
    error = (image - pixels) * np.sqrt(np.where(usable, weights, np.nan)[..., None] / variance)
    squared = (error**2).sum(axis=-1, keepdims=True)
    return np.where(squared <= limit, error, np.nan)
