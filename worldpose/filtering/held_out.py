"""Prediction error of keypoints in cameras that are held out of triangulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.estimate import triangulate_frames
from worldpose.triangulation.settings import TriangulationSettings

FARTHEST: Final = 0.2
"""Maximum error of a keypoint, also of one without a prediction [box height]: half a metre does not
measure the accuracy of a person's position."""


@dataclass(frozen=True)
class HeldOut:
    """Prediction error of so many keypoints in held-out cameras.

    It is the mean distance to the nearest person predicted by the other cameras [box height].
    """

    error: float
    keypoints: int


def measure_held_out(
    cameras: Camera, used: KeypointDetections, detected: AnyFloats, settings: TriangulationSettings
) -> HeldOut | None:
    """Return the prediction error in held-out cameras; None without data.

    One quarter of the cameras after the other is held out; the others triangulate all people, and
    every keypoint detected in the held-out cameras is compared with them. The compared keypoints do
    not depend on tracking or rejection, so leaving detections out cannot reduce the error. `used`
    are NaN where rejected, `detected` (frames, cameras, detections, 17, 2) [px] are all, NaN where
    not found.
    """
    count = cameras.batch_shape[0]
    folds = 4  # Groups of cameras; each is held out once.
    if count - max(1, count // folds) < settings.min_views:
        return None
    fold = np.arange(count) % folds
    used = used.with_points(())

    def measure(left_out: int) -> tuple[float, int]:
        total, keypoints = 0.0, 0
        index = np.where((fold == left_out)[:, None], np.int16(-1), used.detection_index)
        others = replace(used, detection_index=index.astype(np.int16))
        placed = triangulate_frames(cameras, others, settings)
        for camera in np.flatnonzero(fold == left_out):
            seen = np.asarray(detected[:, camera], dtype=np.float64)
            away = _distances(cameras[int(camera)], seen, placed.joints)
            total += float(away.sum())
            keypoints += int(np.isfinite(seen[..., 0]).sum())
        return total, keypoints

    found = list(map_in_threads(measure, range(min(folds, count))))
    total, keypoints = sum(each for each, _ in found), sum(each for _, each in found)
    return HeldOut(total / keypoints, keypoints) if keypoints else None


def _distances(camera: Camera, seen: Floats, joints: Floats) -> Floats:
    """Return distances (frames, detections, 17) [box height] to the nearest person, or 0."""
    frames, persons, count = joints.shape[:3]
    there = np.isfinite(seen).all(-1)
    high = np.where(there, seen[..., 1], -np.inf).max(-1, initial=-np.inf)
    low = np.where(there, seen[..., 1], np.inf).min(-1, initial=np.inf)
    smallest = 10.0  # Minimum height of a box [px].
    height = np.where(there.any(-1), np.maximum(high - low, smallest), smallest)
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, count, 2)
    nearest = np.where(there, FARTHEST, 0.0)
    best = nearest.sum(-1)
    for person in range(persons):
        away = np.linalg.norm(seen - image[:, None, person], axis=-1) / height[..., None]
        away = np.where(there, np.fmin(away, FARTHEST), 0.0)
        total = away.sum(-1)
        better = total < best
        nearest[better], best[better] = away[better], total[better]
    return nearest
