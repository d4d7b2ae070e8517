"""Fit of a lens to places and their pixels: another model for a lens, with the error it leaves.

With places a_i on the plane z = 1, their pixels x_i and the projection pi of the lens L:

    E(L) = 1/2 sum_i |pi(a_i; L) - x_i|^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.cameras import COEFFICIENTS
from data_contracts.conventions import DISTORTION
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.geometry.rigid import Rigid

_PARAMETERS: Final = ("fx", "fy", "cx", "cy", *DISTORTION)
INTRINSICS: Final = _PARAMETERS[:4]
"""Parameters of a fit besides the coefficients of the lens model."""


@dataclass(frozen=True, eq=False)
class FittedLens:
    """A lens fitted to places and their pixels.

    Attributes:
        camera: a single camera at the origin.
        plane: (n, 2) places on the plane z = 1.
        pixels: (n, 2) [px].
    """

    camera: Camera
    plane: Floats
    pixels: Floats

    @cached_property
    def _linear(self) -> tuple[Floats, Floats]:
        """Residuals (n, 2) [px], and derivatives (n, 2, 12) by the parameters."""
        seen = self.camera.project_with_jacobians(np.insert(self.plane, 2, 1.0, axis=1))
        rows = np.concatenate([seen.d_intrinsics, seen.d_distortion], axis=-1)
        return seen.points_image - self.pixels, rows

    @property
    def cost(self) -> float:
        """Sum of squared residuals [px^2]; NaN if the lens cannot image a place."""
        return float((self._linear[0] ** 2).sum())

    @property
    def error_px(self) -> float:
        """Largest distance of a place's image from its pixel [px]."""
        return float(np.linalg.norm(self._linear[0], axis=1).max())

    def step(self, free: Sequence[int], damping: float) -> FittedLens:
        """Return the fit after a damped Gauss-Newton step of some parameters."""
        residuals, rows = self._linear
        rows = rows[..., free].reshape(-1, len(free))
        size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        damped = np.concatenate([rows / size, np.sqrt(damping) * np.eye(len(free))])
        wanted = np.concatenate([-residuals.ravel(), np.zeros(len(free))])
        change = np.zeros(len(_PARAMETERS))
        change[list(free)] = np.linalg.lstsq(damped, wanted)[0] / size
        camera = self.camera
        moved = replace(
            camera,
            focal=camera.focal + change[:2],
            principal_point=camera.principal_point + change[2:4],
            distortion=camera.distortion + change[4:],
        )
        return replace(self, camera=moved)


def fit_lens(
    lens: Camera, plane: Floats, pixels: Floats, model: LensModel, free: Sequence[str]
) -> FittedLens:
    """Return the lens of a model that images places (n, 2) on the plane z = 1 at pixels (n, 2).

    Args:
        lens: a single camera, whose focal length and principal point are a start.
        plane: finite places.
        pixels: their pixels [px].
        model: lens model; coefficients that are not free are 0.
        free: names of the free parameters, of `INTRINSICS` and `DISTORTION`.
    """
    start = replace(lens, distortion=np.zeros(8), lens_model=model, cam_from_world=Rigid.identity())
    chosen = [_PARAMETERS.index(name) for name in free]
    return minimize(
        FittedLens(start, plane, pixels),
        lambda fit, damping: fit.step(chosen, damping),
        Damping(start=1e-3, decrease=10.0, lowest=1e-15, highest=1e8),
        iterations=200,
        converged=lambda before, after: 0.0 <= before.cost - after.cost <= 1e-9 * before.cost,
    ).state


def refit_lens(
    camera: Camera, model: LensModel, free: Sequence[str], stretch: float = 1.0
) -> FittedLens:
    """Return a lens of some model that images as a single camera's does, over its image.

    The error is that over a grid of pixels. Pixels without a ray, beyond the fold of the lens, do
    not count. The new focal length starts at `stretch` times the old one, and places on the plane
    z = 1 are divided by it.
    """
    pixels = camera.image_grid()
    plane = camera.normalize(pixels)
    known = np.isfinite(plane).all(axis=1)
    lens = replace(camera, focal=stretch * camera.focal)
    return fit_lens(lens, plane[known] / stretch, pixels[known], model, free)


def fit_brown_lens(
    camera: Camera, where: str = "fit_brown_lens"
) -> tuple[Camera, dict[str, float | None]]:
    """Return a single camera with the nearest lens of Brown's model, and its errors.

    Focal length and principal point follow, too; the pose stays. Near 90 degrees from the axis no
    polynomial follows a fisheye, and places there would spoil the middle: if a fit to the whole
    image has gross errors, it is to the widest cone about the axis in which errors are small.

    Returns:
        The camera, and `max_error_px` within `fitted_angle_deg` of the axis, and
        `max_error_beyond_px` over the rest of the image; None where Brown's lens folds there.

    Raises:
        InputError: errors are small in less than half of the image.
    """
    # Small and gross errors [px]: 2.2 and 11 px of Full HD.
    most_px, gross_px = (share * float(np.hypot(*camera.image_size)) for share in (0.001, 0.005))
    least_share = 0.5
    free = (*INTRINSICS, *COEFFICIENTS["brown"])
    pixels = camera.image_grid()
    plane = camera.normalize(pixels)
    angle = np.degrees(np.arctan(np.hypot(*plane.T)))
    for share in np.linspace(1.0, 0.5, 11):
        limit = share * np.nanmax(angle)
        near, far = angle <= limit, angle > limit
        fit = fit_lens(camera, plane[near], pixels[near], LensModel.BROWN, free)
        follows = fit.error_px <= (gross_px if share == 1.0 else most_px)
        if follows or near.mean() < least_share:
            break
    if not follows or near.mean() < least_share:
        raise InputError(
            where,
            expected=f"a lens that Brown's model follows to {most_px:.2g} px in half of the image",
            found=f"errors of {fit.error_px:.2g} px within {limit:.0f} degrees of the axis",
            todo="Export a format with the lens itself, or leave this camera out.",
        )
    off = fit.camera.project(np.insert(plane[far], 2, 1.0, axis=1)) - pixels[far]
    beyond = float(np.linalg.norm(off, axis=1).max(initial=0.0))
    errors = {
        "max_error_px": fit.error_px,
        "fitted_angle_deg": float(limit),
        "max_error_beyond_px": beyond if np.isfinite(beyond) else None,
    }
    return replace(fit.camera, cam_from_world=camera.cam_from_world), errors
