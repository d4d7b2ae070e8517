"""Static cameras of calibration.toml: the true ones, or with errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera, Rigid
from worldpose.simulation.settings import CalibrationErrors

PIVOT: Final = 60.0
"""Distance of the point whose projection an error of the center leaves unchanged [m]."""


def misjudge(
    cameras: dict[str, Camera], errors: CalibrationErrors, rng: np.random.Generator
) -> dict[str, Camera]:
    """Return the true cameras with the errors of the settings.

    Args:
        cameras: the true ones by id.
        errors: spreads; all zero returns the true cameras.
        rng: draws the errors, and which cameras are bad.
    """
    bad = rng.permutation(len(cameras))[: errors.bad_cameras]
    given = {}
    for index, (name, camera) in enumerate(cameras.items()):
        factor = errors.bad_factor if index in bad else 1.0
        turn = factor * errors.rotation * rng.standard_normal(3)
        shift = factor * errors.center * rng.standard_normal(3)
        scale = 1.0 + factor * errors.focal * rng.standard_normal()
        given[name] = _moved(camera, turn, shift, scale) if _any(errors) else camera
    return given


def _any(errors: CalibrationErrors) -> bool:
    return max(errors.rotation, errors.center, errors.focal) > 0.0


def _moved(
    camera: Camera, turn: NDArray[np.float64], shift: NDArray[np.float64], scale: float
) -> Camera:
    pose = camera.cam_from_world
    # Seen from the new center, the pivot straight ahead must again be straight ahead.
    seen = np.array([0.0, 0.0, PIVOT]) - pose.rotation @ shift
    axis = np.cross(seen, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    keep = axis / max(length, 1e-12) * np.arctan2(length, seen[2])
    rotation = (
        Rigid.from_rotvec(turn, np.zeros(3)).rotation
        @ Rigid.from_rotvec(keep, np.zeros(3)).rotation
        @ pose.rotation
    )
    moved = Rigid(rotation, -rotation @ (camera.center + shift))
    return replace(camera, focal=camera.focal * scale, cam_from_world=moved)
