"""Image displacement of each person that calibration errors are expected to cause."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.triangulation.reports import Histogram
from worldpose.triangulation.settings import TriangulationSettings

RADIAL = [0, 1, 4]
"""k1, k2, k3 among the five coefficients."""


@dataclass(frozen=True, eq=False)
class StatedErrors:
    """Variance of people's image positions caused by calibration errors.

    Attributes:
        variance: (frames, cameras, persons) per axis [px^2]; 0 where the position is unknown.
        scale: (frames, cameras, persons) image scale there [px/m]; 0 where unknown.
    """

    variance: Floats
    scale: Floats

    def misplaced(self, factor: float) -> tuple[Histogram, ...]:
        """Return the standard deviation at people [m], variance times `factor`, by camera."""
        there = self.variance > 0.0
        variance = np.where(there, self.variance, 0.0) / np.where(there, self.scale, 1.0) ** 2
        root = np.sqrt(factor * variance)
        return tuple(Histogram.of(root[:, c][there[:, c]]) for c in range(there.shape[1]))


def stated_errors(
    cameras: Camera,
    joints: Floats,
    settings: TriangulationSettings,
    camera_covariance: Floats | None,
) -> StatedErrors:
    """Return the variance of each person's position in each image.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, joints, 3) [m], world; their mean is the person's position.
        settings: `calibration_error` replaces a missing covariance.
        camera_covariance: (cameras, 12, 12) of steps in the order of `PARAMETERS`, or None.
    """
    found = np.isfinite(joints[..., 0])
    number = np.maximum(found.sum(axis=-1), 1)[..., None]
    places = np.where(found[..., None], joints, 0.0).sum(axis=-2) / number
    known = found.any(axis=-1)
    pose = cameras.cam_from_world
    shape = (len(joints), len(cameras.focal), joints.shape[1])
    variance, scale = np.zeros(shape), np.zeros(shape)
    for camera in range(shape[1]):
        depth = places @ pose.rotation[camera, 2] + pose.translation[camera, 2]
        # A missing camera sees no person.
        before = known & (depth > 0.0) & bool(np.isfinite(cameras.focal[camera]).all())
        size = np.sqrt(cameras.focal[camera].prod()) / np.where(before, depth, 1.0)
        scale[:, camera] = np.where(before, size, 0.0)
        if camera_covariance is None:
            variance[:, camera] = (settings.calibration_error * scale[:, camera]) ** 2
            continue
        seen = cameras[camera].project_with_jacobians(places[before])
        by_focal = (seen.d_intrinsics[..., :2] * cameras.focal[camera]).sum(-1, keepdims=True)
        steps = (seen.d_pose, by_focal, seen.d_intrinsics[..., 2:], seen.d_distortion[..., RADIAL])
        jacobian = np.concatenate(steps, axis=-1)
        spread = np.einsum("nap,pq,naq->n", jacobian, camera_covariance[camera], jacobian) / 2.0
        variance[:, camera][before] = np.where(np.isfinite(spread), spread, 0.0)
    return StatedErrors(variance, scale)
