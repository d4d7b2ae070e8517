"""Gauge freedom: a similarity transform of all cameras and people, which no keypoint observes.

If no camera was calibrated on markings, only the given cameras define position, orientation and
scale of the world. Adjustment must not change them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry import Camera, Rigid

SIMILARITY: Final = 7
"""Degrees of freedom: translation, rotation, scale."""
_ITERATIONS: Final = 10
"""Reweighted alignments; the last change by less than a micrometre."""


@dataclass(frozen=True)
class Similarity:
    """The transform x' = scale * rotation @ x + translation.

    Attributes:
        scale: factor [1].
        rotation: (3, 3).
        translation: (3,) [m].
    """

    scale: float
    rotation: Floats
    translation: Floats

    def move_points(self, points: Floats) -> Floats:
        """Return points (..., 3) after the transform."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def move_cameras(self, cameras: Camera) -> Camera:
        """Return the cameras (cameras,) that see transformed points in the same pixels."""
        pose = cameras.cam_from_world
        rotation = pose.rotation @ self.rotation.T
        translation = self.scale * pose.translation - rotation @ self.translation
        return replace(cameras, cam_from_world=Rigid(rotation, translation))


def align_points(points: Floats, targets: Floats) -> Similarity:
    """Return the similarity transform that brings points to their targets.

    The weight of a pair depends on its distance over the median distance (Cauchy's weight), so that
    a person or a joint that really moved has little influence.

    Args:
        points: (n, 3) [m].
        targets: (n, 3) [m].

    Returns:
        The identity for fewer than three pairs, or for pairs on one line, which leave it
        undetermined.

    Note:
        Umeyama, PAMI 1991.
    """
    identity = Similarity(1.0, np.eye(3), np.zeros(3))
    if len(points) < 3:
        return identity
    weight, found = np.ones(len(points)), identity
    for _ in range(_ITERATIONS):
        share = weight / weight.sum()
        center, target = share @ points, share @ targets
        away, off = points - center, targets - target
        left, values, right = np.linalg.svd((off * share[:, None]).T @ away)
        if values[1] <= 1e-9 * values[0]:
            return identity
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        rotation = (left * sign) @ right
        scale = float((values * sign).sum() / (share @ (away**2).sum(axis=1)))
        found = Similarity(scale, rotation, target - scale * rotation @ center)
        distance = np.linalg.norm(found.move_points(points) - targets, axis=1)
        weight = 1.0 / (1.0 + (distance / max(float(np.median(distance)), 1e-9)) ** 2)
    return found


def similarity_steps(cameras: Camera, origin: Floats) -> Floats:
    """Return the steps (cameras, 12, 7) of cameras that follow a similarity transform.

    Its parameters are a translation [m], a rotation about `origin` [rad] and the logarithm of a
    scale about `origin`; steps are in the order of `PARAMETERS`.

    Args:
        cameras: (cameras,) batch.
        origin: (3,) [m], world.
    """
    pose = cameras.cam_from_world
    steps = np.zeros((len(pose.rotation), 12, SIMILARITY))
    there = pose.rotation @ origin + pose.translation
    steps[:, 3:6, :3] = -pose.rotation
    steps[:, :3, 3:6] = -pose.rotation
    # A rotation by R theta about the point at `there` in the camera's frame.
    cross = np.cross(np.eye(3), there[:, None, :])
    steps[:, 3:6, 3:6] = cross.swapaxes(1, 2) @ pose.rotation
    steps[:, 3:6, 6] = there
    return steps


def relative_covariance(
    covariance: Floats, cameras: Camera, information: Floats, origin: Floats
) -> tuple[Floats, Floats]:
    """Split the covariance of cameras into individual errors and a common error.

    The common part is the similarity transform that best explains the cameras' errors as pixels at
    the people; the rest is relative.

    Args:
        covariance: (12 cameras, 12 cameras) of steps.
        cameras: (cameras,) batch.
        information: (cameras, 12, 12) of keypoints on each camera alone, used as its weight.
        origin: (3,) [m], world: position of the people.

    Returns:
        (cameras, 12, 12) of each camera's relative step, and (7, 7) of the transform's parameters
        as in `similarity_steps`.
    """
    count, size = information.shape[:2]
    steps = similarity_steps(cameras, origin)
    weighted = information @ steps
    normal = np.einsum("cij,cik->jk", steps, weighted)
    scale = 1.0 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * scale * scale[:, None]) * scale * scale[:, None]
    common_of = inverse @ weighted.reshape(count * size, SIMILARITY).T
    flat = steps.reshape(count * size, SIMILARITY)
    keep = np.eye(count * size) - flat @ common_of
    relative = (keep @ covariance @ keep.T).reshape(count, size, count, size)
    own = relative[np.arange(count), :, np.arange(count)]
    common = common_of @ covariance @ common_of.T
    return 0.5 * (own + own.swapaxes(1, 2)), 0.5 * (common + common.T)
