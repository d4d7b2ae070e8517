"""Ray constraints: lines of sight of joints that one camera alone sees.

All lines of a person in a frame count as parallel. Otherwise the image size would determine the
person's distance, and a hundredth of it, less than any detector's bias, is 0.7 m at 70 m. Motion
and feet on the ground determine the distance better. The moving camera is one more view: its
detections are assigned to known people.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections, TrackedFrames
from worldpose.body_fitting.pose_space import interpolate_gaps
from worldpose.compiled import map_in_threads
from worldpose.geometry.cameras import Camera


@dataclass(frozen=True, eq=False)
class RayConstraints:
    """Lines of sight of joints that are not triangulated."""

    points: Floats
    """(frames, persons, 17, 3) [m], world: of the line, the point nearest to the expected joint;
    NaN without a line."""
    across: Floats
    """(frames, persons, 17, 3, 3) [1], projection that removes the part along the person's lines
    from a vector."""

    def __getitem__(self, frames: slice) -> RayConstraints:
        """Return the lines of sight in some frames."""
        return RayConstraints(self.points[frames], self.across[frames])

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(frames, persons), persons with at least one line."""
        return np.asarray(np.isfinite(self.points[..., 0]).any(-1))


def find_ray_constraints(
    cameras: Camera, detections: TrackedFrames, joints: Floats
) -> RayConstraints:
    """Return the lines of sight of joints that exactly one camera sees.

    If several cameras see a joint and triangulation rejected it, they contradict each other, and
    the correct one is unknown.

    Args:
        cameras: batch (cameras,).
        detections: detections of tracked people, left-right swaps undone.
        joints: (frames, persons, 17, 3) [m], world, triangulated.
    """
    origins = np.full(joints.shape, np.nan)
    directions = np.full(joints.shape, np.nan)
    # Frames of detections in memory at a time.
    block_frames = 256
    blocks = [
        slice(first, min(first + block_frames, len(joints)))
        for first in range(0, len(joints), block_frames)
    ]

    def find(block: tuple[slice, KeypointDetections]) -> tuple[Floats, Floats]:
        rows, seen = block
        return _lone_rays(cameras, seen, joints[rows])

    # Read one after the other, while threads compute.
    read = ((rows, detections[rows]) for rows in blocks)
    for rows, found in zip(blocks, map_in_threads(find, read), strict=True):
        origins[rows], directions[rows] = found
    alone = np.isfinite(directions).any()
    return lines_of_sight(origins, directions, expected_joints(joints) if alone else joints)


def _lone_rays(
    cameras: Camera, detections: KeypointDetections, joints: Floats
) -> tuple[Floats, Floats]:
    """Return origins and directions (frames, persons, 17, 3) of joints that one camera sees."""
    index = detections.detection_index
    frames, count, persons = index.shape
    origins = np.full(joints.shape, np.nan)
    directions = np.full(joints.shape, np.nan)
    frame, camera, person = np.nonzero(index >= 0)
    own = np.full((frames, count, persons, 17, 2), np.nan)
    place = index[frame, camera, person]
    own[frame, camera, person] = detections.keypoints[frame, camera, place]
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
    return origins, directions


def lines_of_sight(origins: Floats, directions: Floats, expected: Floats) -> RayConstraints:
    """Return rays as lines of sight, parallel per person and frame.

    Origins, expected (approximate) joints [m], world, and directions, of any length or NaN without
    a ray, are (frames, persons, 17, 3).
    """
    points, across = np.full(directions.shape, np.nan), np.zeros((*directions.shape, 3))
    # Most people have none: their arrays are not computed.
    rows = np.isfinite(directions).all(-1).any(-1)
    origins, along, expected = origins[rows], directions[rows], expected[rows]
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    far = np.maximum(((expected - origins) * along).sum(-1, keepdims=True), 0.0)
    found = origins + far * along
    lost = ~np.isfinite(found).all(-1)
    found[lost], along[lost] = np.nan, 0.0
    mean = along.sum(axis=1, keepdims=True)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    mean = mean / np.maximum(length, 1e-9)
    projection = np.eye(3) - mean[..., :, None] * mean[..., None, :]
    points[rows] = found
    across[rows] = np.where(lost[..., None, None], 0.0, projection)
    return RayConstraints(points, across)


def expected_joints(joints: Floats) -> Floats:
    """Return expected joints of tracks in every frame; NaN for persons never seen.

    A joint is interpolated between observations; a joint never seen is in the middle of the others.
    """
    full = np.stack(
        [interpolate_gaps(joints[:, person]) for person in range(joints.shape[1])], axis=1
    )
    known = np.isfinite(full)
    middle = np.where(known, full, 0.0).sum(axis=2) / np.maximum(known.sum(axis=2), 1)
    middle[~known.any(axis=2)] = np.nan
    return np.where(known, full, middle[:, :, None])


def identify_people(camera: Camera, keypoints: NDArray[np.floating], joints: Floats) -> Floats:
    """Return the keypoints (frames, persons, 17, 2) [px] of known people; NaN where not seen.

    The assignment minimizes the mean distances to projected joints, frame by frame. The camera is
    (frames,), keypoints are (frames, detections, 17, 2) [px], NaN where not found, and joints
    (frames, persons, 17, 3) [m], world, at the times of the images.
    """
    frames, persons = joints.shape[:2]
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)
    known = np.isfinite(image[..., 1])
    high = np.where(known, image[..., 1], -np.inf).max(-1, initial=-np.inf)
    height = high - np.where(known, image[..., 1], np.inf).min(-1, initial=np.inf)
    own = np.full((frames, persons, 17, 2), np.nan)
    # Maximum mean distance between keypoints and their person's joints [person height].
    gate = 0.2
    for frame in range(frames):
        away = np.linalg.norm(image[frame, :, None] - keypoints[frame, None], axis=-1)
        both = np.isfinite(away)
        count = both.sum(-1)
        mean = np.where(both, away, 0.0).sum(-1) / np.maximum(count, 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            # Minimum keypoints to identify people [1].
            mean = np.where(count >= 6, mean / height[frame, :, None], np.inf)
        mean = np.where(np.isfinite(mean), mean, np.inf)
        person, detection = linear_sum_assignment(np.minimum(mean, gate))
        near = mean[person, detection] < gate
        own[frame, person[near]] = keypoints[frame, detection[near]]
    return own


def constrain_to_rays(camera: Camera, keypoints: Floats, joints: Floats) -> RayConstraints:
    """Return the lines of sight of joints in a moving camera (frames,), at points near the joints.

    Keypoints are (frames, persons, 17, 2) [px] of each person, NaN where not seen, and joints
    (frames, persons, 17, 3) [m], world.
    """
    frames, persons = joints.shape[:2]
    rays = camera.unproject(keypoints.reshape(frames, -1, 2))
    shape = (frames, persons, 17, 3)
    origins = np.broadcast_to(rays.origins, rays.directions.shape).reshape(shape)
    return lines_of_sight(origins, rays.directions.reshape(shape), joints)
