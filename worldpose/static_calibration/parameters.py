"""Parameters of a static camera, derivatives of pixels by them, and compiled residuals.

Residuals are those of clicks, drawn points and priors, in standard deviations. Kernels take a
camera as the row of 22 numbers of `worldpose.geometry.projection`; a step has the order of
`PARAMETERS`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats, Integers
from data_contracts.static_calibration import CAMERA_STEP
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera, Projection
from worldpose.geometry.projection import fold_squared, project_with_jacobians

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
    k1, k2, _, _, k3 = camera.distortion
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
    parts = (
        seen.d_pose,
        by_focal,
        seen.d_intrinsics[..., 2:],
        seen.d_distortion[..., [0, 1, 4]],
    )
    return np.concatenate(parts, axis=-1)


SIZE: Final = 12
"""Parameters of a step."""
PRIORS: Final = 9
"""Rows of the prior: focal, cx, cy, k1, k2, k3, height, distance, roll."""

_LOST_RESIDUAL: Final = 1e3
"""Residual [px] of points that the camera cannot image: larger than any true residual."""


@compile_kernel
def point_residuals(
    c: Floats, world: Floats, pixels: Floats, residual: Floats, jacobian: Floats
) -> None:
    """Write pixel residuals (n, 2) of points and their derivatives (n, 2, 12) by a step [px].

    Beyond the radius where the lens folds, the magnification at that radius applies, so that image
    radii keep growing. If points folded back into the image, a strong distortion would fit a point
    under a wrong name.
    """
    n = len(world)
    fold = fold_squared(c[4], c[5], c[8])
    straight = c.copy()
    place, pixel = np.empty((1, 1, 3)), np.empty((1, 1, 2))
    by_all, code = np.empty((1, 1, 2, 18)), np.empty((1, 1), dtype=np.uint8)
    image = np.empty((1, n, 2))
    full = np.empty((1, n, 2, 18))
    status = np.empty((1, n), dtype=np.uint8)
    project_with_jacobians(c.reshape(1, 22), world.reshape(1, n, 3), image, full, status)
    magnification = 1.0
    if fold < np.inf:
        magnification += fold * (c[4] + fold * (c[5] + fold * c[8]))
        straight[0], straight[1] = magnification * c[0], magnification * c[1]
        straight[4:9] = 0.0
    for i in range(n):
        s = fold
        if fold < np.inf and status[0, i] == 0:
            z = c[15] * world[i, 0] + c[16] * world[i, 1] + c[17] * world[i, 2] + c[20]
            x = c[9] * world[i, 0] + c[10] * world[i, 1] + c[11] * world[i, 2] + c[18]
            y = c[12] * world[i, 0] + c[13] * world[i, 1] + c[14] * world[i, 2] + c[19]
            s = (x * x + y * y) / (z * z)
            if s > fold:
                place[0, 0] = world[i]
                project_with_jacobians(straight.reshape(1, 22), place, pixel, by_all, code)
                image[0, i], full[0, i], status[0, i] = pixel[0, 0], by_all[0, 0], code[0, 0]
        for k in range(2):
            if status[0, i] != 0:
                residual[i, k] = _LOST_RESIDUAL
                jacobian[i, k] = 0.0
                continue
            d = full[0, i, k]
            residual[i, k] = image[0, i, k] - pixels[i, k]
            for j in range(6):
                jacobian[i, k, j] = d[3 + j]
            jacobian[i, k, 6] = image[0, i, k] - c[2 + k]
            jacobian[i, k, 7], jacobian[i, k, 8] = d[11], d[12]
            if s > fold:
                # The derivative of the fold radius is left out: the loop rejects steps that do
                # not lower the cost.
                plane = (image[0, i, k] - c[2 + k]) / magnification
                for j in range(3):
                    jacobian[i, k, 9 + j] = plane * fold ** (1 + j)
                continue
            jacobian[i, k, 9], jacobian[i, k, 10], jacobian[i, k, 11] = d[13], d[14], d[17]


@compile_kernel
def nearest_on_markings(
    c: Floats,
    reach: float,
    samples: Floats,
    bounds: Integers,
    pixels: Floats,
    marking: Integers,
    place: Floats,
    normal: Floats,
) -> None:
    """Write the nearest place on its marking of each drawn pixel, and the unit normal there.

    Args:
        c: (22,) camera.
        reach: half the image diagonal [px].
        samples: (s, 3) [m], world.
        bounds: (m + 1,); samples `bounds[k]` to `bounds[k + 1]` belong to marking k.
        pixels: (d, 2) [px].
        marking: (d,).
        place: (d, 3) [m], world, written; NaN where the marking is not in front of the camera.
        normal: (d, 2), written: from the marking to the pixel, either sign.
    """
    max_radius = 1.5  # beyond, polynomials may fold a marking back into the image
    cap = min((max_radius * reach / c[0]) ** 2, fold_squared(c[4], c[5], c[8]))
    image = np.empty((len(samples), 2))
    for i in range(len(samples)):
        p = samples[i]
        z = c[15] * p[0] + c[16] * p[1] + c[17] * p[2] + c[20]
        if z < 0.5:
            image[i] = np.nan
            continue
        x = (c[9] * p[0] + c[10] * p[1] + c[11] * p[2] + c[18]) / z
        y = (c[12] * p[0] + c[13] * p[1] + c[14] * p[2] + c[19]) / z
        s = min(x * x + y * y, cap)
        radial = 1.0 + s * (c[4] + s * (c[5] + s * c[8]))
        image[i, 0] = c[0] * x * radial + c[2]
        image[i, 1] = c[1] * y * radial + c[3]
    for i in range(len(pixels)):
        best = np.inf
        place[i] = np.nan
        normal[i] = 0.0
        for j in range(bounds[marking[i]], bounds[marking[i] + 1] - 1):
            ax, ay = image[j, 0], image[j, 1]
            dx, dy = image[j + 1, 0] - ax, image[j + 1, 1] - ay
            ex, ey = pixels[i, 0] - ax, pixels[i, 1] - ay
            length = max(dx * dx + dy * dy, 1e-18)
            share = min(max((ex * dx + ey * dy) / length, 0.0), 1.0)
            ox, oy = ex - share * dx, ey - share * dy
            distance = ox * ox + oy * oy
            # A NaN on either end compares false.
            if distance < best:
                best = distance
                for k in range(3):
                    place[i, k] = (1.0 - share) * samples[j, k] + share * samples[j + 1, k]
                root = np.sqrt(length)
                normal[i, 0], normal[i, 1] = -dy / root, dx / root
                off = np.sqrt(distance)
                # Beyond the marking's end the nearest point is the end itself.
                if (share == 0.0 or share == 1.0) and off > 1e-9:
                    normal[i, 0], normal[i, 1] = ox / off, oy / off


@compile_kernel
def drawn_residuals(
    c: Floats,
    reach: float,
    samples: Floats,
    bounds: Integers,
    pixels: Floats,
    marking: Integers,
    residual: Floats,
    jacobian: Floats,
) -> None:
    """Write distances (d,) of drawn pixels to their projected markings, and derivatives (d, 12).

    The derivative ignores the place along the marking: at the nearest point the distance is
    stationary in it, so that the derivative is the normal times that of the point's pixel.
    """
    n = len(pixels)
    place = np.empty((n, 3))
    normal = np.empty((n, 2))
    nearest_on_markings(c, reach, samples, bounds, pixels, marking, place, normal)
    both = np.empty((n, 2))
    by_step = np.empty((n, 2, SIZE))
    point_residuals(c, place, pixels, both, by_step)
    for i in range(n):
        if np.isnan(place[i, 0]) or both[i, 0] == _LOST_RESIDUAL:
            residual[i] = _LOST_RESIDUAL
            jacobian[i] = 0.0
            continue
        residual[i] = normal[i, 0] * both[i, 0] + normal[i, 1] * both[i, 1]
        for j in range(SIZE):
            jacobian[i, j] = normal[i, 0] * by_step[i, 0, j] + normal[i, 1] * by_step[i, 1, j]


@compile_kernel
def prior_residuals(c: Floats, prior: Floats, residual: Floats, jacobian: Floats) -> None:
    """Write the prior's residuals (9,) and derivatives (9, 12).

    Args:
        c: (22,) camera.
        prior: (21,) log focal, its spread; cx, cy, their spread; half diagonal [px]; spreads of
            k1, k2, k3; log height, its spread; log distance, its spread; spread of the roll; the
            minimum height [m]; spreads of k1, k2, k3 as coefficients; the middles of k1, k2, k3 as
            displacements of the corner.
        residual: (9,), written.
        jacobian: (9, 12), written.
    """
    jacobian[:] = 0.0
    residual[0] = (np.log(c[0]) - prior[0]) / prior[1]
    jacobian[0, 6] = 1.0 / prior[1]
    for k in range(2):
        residual[1 + k] = (c[2 + k] - prior[2 + k]) / prior[4]
        jacobian[1 + k, 7 + k] = 1.0 / prior[4]
    squared = (prior[5] / c[0]) ** 2
    power = 1.0
    for k in range(3):
        power *= squared
        # The displacement of the image corner: it shrinks with the focal length.
        value = c[8] if k == 2 else c[4 + k]
        spread = np.hypot(prior[6 + k], prior[15 + k] * power)
        residual[3 + k] = (value * power - prior[18 + k]) / spread
        jacobian[3 + k, 9 + k] = power / spread
        # Displacement and spread both depend on the focal length.
        wide = (prior[15 + k] * power / spread) ** 2
        jacobian[3 + k, 6] = -2.0 * (k + 1.0) * (value * power / spread - residual[3 + k] * wide)
    # The center moves by -R^T d with the step's shift d, and not with its rotation.
    x = -(c[9] * c[18] + c[12] * c[19] + c[15] * c[20])
    y = -(c[10] * c[18] + c[13] * c[19] + c[16] * c[20])
    z = -(c[11] * c[18] + c[14] * c[19] + c[17] * c[20])
    high = max(z, prior[14])
    # Below the minimum height the tangent continues the logarithm: no camera is underground, where
    # mirrored names would put it.
    residual[6] = (np.log(high) + (z - high) / high - prior[9]) / prior[10]
    far = max(np.sqrt(x * x + y * y), 1.0)
    residual[7] = (np.log(far) - prior[11]) / prior[12]
    for k in range(3):
        jacobian[6, 3 + k] = -c[11 + 3 * k] / high / prior[10]
        along = (x * c[9 + 3 * k] + y * c[10 + 3 * k]) / far
        jacobian[7, 3 + k] = -along / far / prior[12]
    residual[8] = c[11] / prior[13]
    jacobian[8, 1] = c[17] / prior[13]
    jacobian[8, 2] = -c[14] / prior[13]
