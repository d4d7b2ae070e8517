"""Parameters of a static camera, and derivatives of pixels by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats
from data_contracts.static_calibration import CAMERA_STEP
from worldpose.geometry.cameras import Camera, Projection

PARAMETERS: Final = CAMERA_STEP
"""Steps of a camera: rotation about its center [rad] and shift [m] in its own axes
(`Rigid.retract`), the logarithm of the focal length, principal point [px], distortion [1]."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """A camera and its covariance.

    Attributes:
        camera: a single camera with square pixels.
        covariance: (12, 12) covariance of a step in the order of `PARAMETERS`; rows and columns of
            fixed parameters are zero.
    """

    camera: Camera
    covariance: Floats


@dataclass(frozen=True, eq=False)
class CameraOnPitch:
    """A camera, the surface of the pitch that it sees, and their covariance.

    Attributes:
        camera: a single camera with square pixels.
        surface: (2,) crown and end fall of the pitch [m].
        covariance: (14, 14) covariance of a step of the camera and of the surface; rows and columns
            of fixed parameters are zero.
    """

    camera: Camera
    surface: Floats
    covariance: Floats

    @classmethod
    def on_known_surface(cls, found: CameraEstimate, surface: tuple[float, float]) -> CameraOnPitch:
        """Return a camera on a pitch whose crown and end fall [m] are known."""
        size = len(found.covariance)
        whole = np.zeros((size + 2, size + 2))
        whole[:size, :size] = found.covariance
        return cls(found.camera, np.array(surface), whole)

    @property
    def estimate(self) -> CameraEstimate:
        """The camera, whose covariance includes the uncertainty of the surface."""
        return CameraEstimate(self.camera, self.covariance[:-2, :-2])

    def step_to(self, camera: Camera, surface: Floats) -> Floats:
        """Return the (14,) step from here to another camera and surface."""
        return np.concatenate([step_between(self.camera, camera), surface - self.surface])


def step_camera(camera: Camera, step: ArrayLike) -> Camera:
    """Return cameras (...) with square pixels after a step (..., 12), see `PARAMETERS`."""
    step = np.asarray(step, dtype=np.float64)
    distortion = camera.distortion.copy()
    distortion[..., [0, 1, 4]] += step[..., 9:]
    return replace(
        camera,
        focal=camera.focal * np.exp(step[..., 6:7]),
        principal_point=camera.principal_point + step[..., 7:9],
        distortion=distortion,
        cam_from_world=camera.cam_from_world.retract(step[..., :6]),
    )


def drop_k3(camera: Camera) -> Camera:
    """Return the camera whose k1 and k2 alone bend its image as k1, k2 and k3 do, about.

    A coefficient that no fit changes is a statement about the lens. That of a guessed lens moved
    two real cameras by 2 and 7 px.
    """
    k1, k2, _, _, k3 = camera.distortion[:5]
    corner = 0.5 * float(np.hypot(*camera.image_size)) / float(camera.focal[0])
    radius = np.linspace(0.01, 2.0, 400) * corner
    bent = radius * (1.0 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
    # Beyond the first fold the model shows nothing.
    seen = np.logical_and.accumulate((bent <= corner) & (np.diff(bent, prepend=0.0) > 0.0))
    powers = radius[seen, None] ** np.array([3.0, 5.0])
    distortion = camera.distortion.copy()
    distortion[:2] = np.linalg.lstsq(powers, (bent - radius)[seen], rcond=None)[0]
    distortion[4] = 0.0
    return replace(camera, distortion=distortion)


def step_jacobian(step: Floats) -> Floats:
    """Return the derivative (n, n) of a camera's step (n,) by a further step after it."""
    chain = np.eye(len(step))
    x, y, z = step[3:6]
    # A further rotation also rotates the translation so far.
    chain[3:6, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return chain


def step_between(start: Camera, camera: Camera) -> Floats:
    """Return the (12,) step from one camera to another."""
    moved = camera.cam_from_world @ start.cam_from_world.inverse()
    return np.concatenate(
        [
            moved.rotvec,
            moved.translation,
            np.log(camera.focal[:1] / start.focal[:1]),
            camera.principal_point - start.principal_point,
            (camera.distortion - start.distortion)[[0, 1, 4]],
        ]
    )


def project_with_jacobian(camera: Camera, points_world: ArrayLike) -> tuple[Floats, Floats]:
    """Return pixels (n, 2) [px] of places (n, 3) [m], world, and derivatives (n, 2, 12) by a step.

    They are NaN for points behind the single camera, and where the lens model is not one to one.
    """
    seen = camera.project_with_jacobians(points_world)
    return seen.points_image, by_step(camera, seen)


def by_step(camera: Camera, seen: Projection) -> Floats:
    """Return derivatives (n, 2, 12) by a step, from those of a single camera's projection."""
    by_focal = (seen.d_intrinsics[..., :2] * camera.focal).sum(axis=-1, keepdims=True)
    parts = (seen.d_pose, by_focal, seen.d_intrinsics[..., 2:], seen.d_distortion[..., [0, 1, 4]])
    return np.concatenate(parts, axis=-1)
