"""The moving camera as one more view: detections of known people, and lines of sight (S4)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats
from worldpose.body_fitting.ray_constraints import Sightings, lines_of_sight
from worldpose.geometry import Camera

GATE: Final = 0.2
"""Maximum mean distance between keypoints and their person's joints [person height]."""
FEWEST: Final = 6
"""Minimum keypoints to identify people [1]."""


def recognise_people(camera: Camera, keypoints: NDArray[np.floating], joints: Floats) -> Floats:
    """Return the keypoints (frames, persons, 17, 2) [px] of known people; NaN where not seen.

    The assignment minimizes the mean distances to projected joints, frame by frame.

    Args:
        camera: batch (frames,).
        keypoints: (frames, detections, 17, 2) [px]; NaN where not found.
        joints: (frames, persons, 17, 3) [m], world, at the times of the images.
    """
    frames, persons = joints.shape[:2]
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)
    known = np.isfinite(image[..., 1])
    high = np.where(known, image[..., 1], -np.inf).max(-1, initial=-np.inf)
    height = high - np.where(known, image[..., 1], np.inf).min(-1, initial=np.inf)
    own = np.full((frames, persons, 17, 2), np.nan)
    for frame in range(frames):
        away = np.linalg.norm(image[frame, :, None] - keypoints[frame, None], axis=-1)
        both = np.isfinite(away)
        count = both.sum(-1)
        mean = np.where(both, away, 0.0).sum(-1) / np.maximum(count, 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(count >= FEWEST, mean / height[frame, :, None], np.inf)
        mean = np.where(np.isfinite(mean), mean, np.inf)
        person, detection = linear_sum_assignment(np.minimum(mean, GATE))
        near = mean[person, detection] < GATE
        own[frame, person[near]] = keypoints[frame, detection[near]]
    return own


def sight_people(camera: Camera, keypoints: Floats, joints: Floats) -> Sightings:
    """Return the lines of sight of joints in a moving camera.

    Args:
        camera: batch (frames,).
        keypoints: (frames, persons, 17, 2) [px] of each person; NaN where not seen.
        joints: (frames, persons, 17, 3) [m], world; the lines' points are the nearest to these.
    """
    frames, persons = joints.shape[:2]
    rays = camera.unproject(keypoints.reshape(frames, -1, 2))
    shape = (frames, persons, 17, 3)
    origins = np.broadcast_to(rays.origins, rays.directions.shape).reshape(shape)
    return lines_of_sight(origins, rays.directions.reshape(shape), joints)


def between_frames(values: Floats, late: float) -> Floats:
    """Return values (frames, ...) `late` frames later, linearly interpolated; NaN beyond ends."""
    before = np.arange(len(values)) + int(np.floor(late))
    share = late - np.floor(late)

    def taken(places: NDArray[np.int64]) -> Floats:
        out = np.full(values.shape, np.nan)
        inside = (places >= 0) & (places < len(values))
        out[inside] = values[places[inside]]
        return out

    return (1.0 - share) * taken(before) + share * taken(before + 1) if share else taken(before)
