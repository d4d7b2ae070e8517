"""Lines of sight of joints that only one camera sees.

All lines of a person in a frame count as parallel. Otherwise the image size would determine the
person's distance, and a hundredth of it, less than any detector's bias, is 0.7 m at 70 m. Motion
and feet on the ground determine the distance better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body_fitting.starting import bridged
from worldpose.geometry import Camera


@dataclass(frozen=True, eq=False)
class Sightings:
    """Lines of sight of joints that are not triangulated."""

    points: Floats
    """(frames, persons, 17, 3) [m], world: of the line, the point nearest to the expected joint;
    NaN without a line."""
    across: Floats
    """(frames, persons, 17, 3, 3) [1], projection that removes the part along the person's lines
    from a vector."""

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

    If several cameras see a joint and triangulation rejected it, they contradict each other, and
    the correct one is unknown.

    Args:
        cameras: batch (cameras,).
        keypoints: (frames, cameras, detections, 17, 2) [px], left-right swaps undone; NaN where not
            found.
        detection_index: (frames, cameras, persons), index of the detection; -1 = not seen.
        joints: (frames, persons, 17, 3) [m], world, triangulated.
    """
    frames, count, persons = detection_index.shape
    origins = np.full(joints.shape, np.nan)
    directions = np.full(joints.shape, np.nan)
    frame, camera, person = np.nonzero(detection_index >= 0)
    own = np.full((frames, count, persons, 17, 2), np.nan)
    own[frame, camera, person] = keypoints[frame, camera, detection_index[frame, camera, person]]
    there = np.isfinite(own).all(-1)
    alone = (there.sum(axis=1) == 1) & ~np.isfinite(joints).all(-1)
    frame, person, joint = np.nonzero(alone)
    camera = there.argmax(axis=1)[frame, person, joint]
    for each in range(count):
        mine = camera == each
        if not mine.any():
            continue
        at = frame[mine], person[mine], joint[mine]
        rays = cameras[each].unproject(own[at[0], each, at[1], at[2]])
        origins[at], directions[at] = rays.origins, rays.directions
    return lines_of_sight(origins, directions, expected_joints(joints) if alone.any() else joints)


def lines_of_sight(origins: Floats, directions: Floats, expected: Floats) -> Sightings:
    """Return rays as lines of sight, parallel per person and frame.

    Args:
        origins: (frames, persons, 17, 3) [m], world.
        directions: (frames, persons, 17, 3), of any length; NaN without a ray.
        expected: (frames, persons, 17, 3) [m], world, approximate joints.
    """
    along = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    far = np.maximum(((expected - origins) * along).sum(-1, keepdims=True), 0.0)
    points = origins + far * along
    lost = ~np.isfinite(points).all(-1)
    points[lost], along[lost] = np.nan, 0.0
    mean = along.sum(axis=2, keepdims=True)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    mean = mean / np.maximum(length, 1e-9)
    across = np.eye(3) - mean[..., :, None] * mean[..., None, :]
    return Sightings(points, np.where(lost[..., None, None], 0.0, across))


def expected_joints(joints: Floats) -> Floats:
    """Return expected joints of tracks in every frame; NaN for persons never seen.

    A joint is interpolated between observations; a joint never seen is in the middle of the others.
    """
    full = np.stack([bridged(joints[:, person]) for person in range(joints.shape[1])], axis=1)
    known = np.isfinite(full)
    middle = np.where(known, full, 0.0).sum(axis=2) / np.maximum(known.sum(axis=2), 1)
    middle[~known.any(axis=2)] = np.nan
    return np.where(known, full, middle[:, :, None])
