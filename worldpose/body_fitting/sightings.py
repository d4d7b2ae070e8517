"""Joints that one camera alone sees: somewhere on a line, which is much better than nowhere.

All lines of a person in a frame are taken for parallel: how far away he is would follow from how
large he looks, and a hundredth of that, less than any detector's bias, is 0.7 m at 70 m. Motion and
feet on the ground know it better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.body_fitting.starting import bridged
from worldpose.cameras import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sightings:
    """Lines of sight of joints that are not triangulated."""

    points: Floats
    """(frames, persons, 17, 3) [m], world: of the line, the point nearest to where the track puts
    the joint; NaN where there is no line or more than one."""
    across: Floats
    """(frames, persons, 17, 3, 3) [1], what takes the part along his lines from a vector."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(frames, persons), persons with at least one line."""
        return np.asarray(np.isfinite(self.points[..., 0]).any(-1))


def find_sightings(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    detection_index: NDArray[np.integer],
    joints: Floats,
) -> Sightings:
    """Return the lines of sight of joints that exactly one camera sees.

    Where several cameras see a joint and triangulation refused it, they contradict each other, and
    nobody knows which one is right.

    Args:
        cameras: batch (cameras,).
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        detection_index: (frames, cameras, persons), place among the detections; -1 = not seen.
        joints: (frames, persons, 17, 3) [m], world, triangulated.
    """
    frames, count, persons = detection_index.shape
    points = np.full(joints.shape, np.nan)
    ahead = np.full(joints.shape, np.nan)
    frame, camera, person = np.nonzero(detection_index >= 0)
    own = np.full((frames, count, persons, 17, 2), np.nan)
    own[frame, camera, person] = keypoints[frame, camera, detection_index[frame, camera, person]]
    there = np.isfinite(own).all(-1)
    alone = (there.sum(axis=1) == 1) & ~np.isfinite(joints).all(-1)
    frame, person, joint = np.nonzero(alone)
    camera = there.argmax(axis=1)[frame, person, joint]
    expected = _expected(joints) if len(frame) else joints
    for each in range(count):
        mine = camera == each
        if not mine.any():
            continue
        at = frame[mine], person[mine], joint[mine]
        rays = cameras[each].unproject(own[at[0], each, at[1], at[2]])
        along = rays.directions / np.linalg.norm(rays.directions, axis=-1, keepdims=True)
        far = np.maximum(((expected[at] - rays.origins) * along).sum(-1, keepdims=True), 0.0)
        points[at], ahead[at] = rays.origins + far * along, along
    lost = ~np.isfinite(points).all(-1)
    points[lost], ahead[lost] = np.nan, 0.0
    mean = ahead.sum(axis=2, keepdims=True)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    mean = mean / np.maximum(length, 1e-9)
    across = np.eye(3) - mean[..., :, None] * mean[..., None, :]
    return Sightings(points, np.where(lost[..., None, None], 0.0, across))


def _expected(joints: Floats) -> Floats:
    """Where tracks put joints in every frame: between what is seen, the middle of the others else.

    NaN for persons whose joints are never seen.
    """
    full = np.stack([bridged(joints[:, person]) for person in range(joints.shape[1])], axis=1)
    known = np.isfinite(full)
    middle = np.where(known, full, 0.0).sum(axis=2) / np.maximum(known.sum(axis=2), 1)
    middle[~known.any(axis=2)] = np.nan
    return np.where(known, full, middle[:, :, None])
