"""Expected error of positions on the pitch, from a camera's covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.parameters import CameraEstimate, project_with_jacobian

_MARGIN = 2.0
"""Margin of the map beyond the outer lines [m]: people stand there."""
_NUDGE = 0.01
"""Step of the surface's slope [m]."""
_GRAZING = 1e-9
"""Minimum image area of a square metre of ground [px^2]: less is the horizon."""


@dataclass(frozen=True, eq=False)
class GroundErrorMap:
    """Expected ground error over the pitch: the coverage map of one camera.

    Attributes:
        x: (columns,) [m], world.
        y: (rows,) [m], world.
        expected: (rows, columns) [m], root mean square distance on the surface between a place
            and the back-projection of its true pixel by the estimated camera; NaN outside the
            field of view.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    expected: NDArray[np.float64]

    @property
    def median(self) -> float:
        """Median over the field of view [m]; infinite if the camera sees nothing."""
        return self._quantile(0.5)

    @property
    def p95(self) -> float:
        """95th percentile over the field of view [m]."""
        return self._quantile(0.95)

    def _quantile(self, share: float) -> float:
        seen = self.expected[np.isfinite(self.expected)]
        return float(np.quantile(seen, share)) if seen.size else float("inf")


def ground_error_map(estimate: CameraEstimate, pitch: PitchTemplate, step: float) -> GroundErrorMap:
    """Return the expected ground error of an estimate on a grid over the pitch.

    Args:
        estimate: camera and covariance.
        pitch: template with size and surface.
        step: maximum grid spacing [m].
    """
    x, y = (
        np.linspace(-half, half, int(np.ceil(2.0 * half / step)) + 1)
        for half in (0.5 * pitch.length + _MARGIN, 0.5 * pitch.width + _MARGIN)
    )
    across, along = np.meshgrid(y, x, indexing="ij")
    places = np.stack([along, across, pitch.height(along, across)], axis=-1).reshape(-1, 3)
    expected = expected_ground_error(estimate, pitch, places)
    pixels = estimate.camera.project(places)
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= -0.5) & (pixels <= estimate.camera.image_size - 0.5)).all(axis=1)
    return GroundErrorMap(x, y, np.where(seen, expected, np.nan).reshape(across.shape))


def expected_ground_error(
    estimate: CameraEstimate, pitch: PitchTemplate, places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the expected ground error (n,) [m] at places on the surface.

    Args:
        estimate: camera and covariance.
        pitch: template with the surface.
        places: (n, 3) [m], world, on the surface.

    Returns:
        NaN where the camera cannot image the place.
    """
    motion = surface_motion(estimate.camera, pitch, places)
    squared = np.einsum("nij,jk,nik->n", motion, estimate.covariance, motion)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def surface_motion(
    camera: Camera, pitch: PitchTemplate, places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return derivatives of back-projected places on the surface by the camera's step.

    The pixel of a place moves with the step; the place on the surface with this pixel moves by the
    inverse of the pixel's derivative along the surface.

    Args:
        camera: a single camera.
        pitch: template with the surface.
        places: (n, 3) [m], world, on the surface.

    Returns:
        (n, 2, 12) [m]; NaN where the camera cannot image the place.
    """
    _, by_step = project_with_jacobian(camera, places)
    by_place = camera.project_with_jacobians(places).d_points
    slopes = [
        (pitch.height(places[:, 0] + dx, places[:, 1] + dy) - places[:, 2]) / _NUDGE
        for dx, dy in ((_NUDGE, 0.0), (0.0, _NUDGE))
    ]
    surface = by_place[:, :, :2] + by_place[:, :, 2:] * np.stack(slopes, axis=-1)[:, None, :]
    (a, b), (c, d) = np.moveaxis(surface, 0, -1)
    area = a * d - b * c
    with np.errstate(invalid="ignore", divide="ignore"):
        area = np.where(np.abs(area) > _GRAZING, area, np.nan)
    inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / area, -1, 0)
    return np.asarray(inverse @ by_step)
