"""Direction of largest camera uncertainty, with the names of its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera
from worldpose.static_calibration import PARAMETERS, project_with_jacobian

_DISTANCE: Final = 60.0
"""Distance of the points whose image motion makes parameters comparable [m]."""
_NAMED: Final = 0.25
"""Share of the largest component from which a parameter is named [1]."""


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """Direction in which people and markings constrain a camera least.

    Attributes:
        step: (12,) one standard deviation along it, in the units of `PARAMETERS`.
        about: parameters that move together, with their steps.
    """

    step: NDArray[np.float64]
    about: str


def weak_direction(camera: Camera, covariance: NDArray[np.float64]) -> WeakDirection:
    """Return the direction of largest variance.

    Parameters are scaled by the image motion of each alone; along a weak direction these motions
    cancel.

    Args:
        camera: a single camera.
        covariance: (12, 12) of a step.
    """
    width, height = camera.image_size
    across, down = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 6))
    rays = camera.unproject(np.stack([across, down], axis=-1).reshape(-1, 2))
    seen = rays.origins + _DISTANCE * rays.directions
    _, by_step = project_with_jacobian(camera, seen[np.isfinite(seen).all(axis=1)])
    pixels = np.sqrt(np.nanmean((by_step**2).sum(axis=1), axis=0))
    values, vectors = np.linalg.eigh(covariance * np.outer(pixels, pixels))
    step = np.sqrt(max(values[-1], 0.0)) * vectors[:, -1] / pixels
    if not step.any():
        return WeakDirection(step, "not known")
    moved = np.abs(vectors[:, -1])
    named = np.flatnonzero(moved > _NAMED * moved.max())
    named = named[np.argsort(-moved[named], kind="stable")]
    parts = [f"{PARAMETERS[k]} {step[k]:+.2g}{_UNITS[k]}" for k in named]
    return WeakDirection(step, ", ".join(parts))


_UNITS: Final = (" rad",) * 3 + (" m",) * 3 + ("", " px", " px", "", "", "")
