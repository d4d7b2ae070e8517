"""Where the cameras stand: a ring around the part of the pitch where people are."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.cameras import Camera, Rigid
from worldpose.synthetic.scenarios import RigSettings

STANDARD_PERSON: Final = 1.8
"""Body height that `RigSettings.person_height` speaks of [m]."""

GOLDEN: Final = (np.sqrt(5.0) - 1.0) / 2.0
"""Steps of this share of a turn spread any number of cameras, and one more moves none of them."""


def place_camera(
    rig: RigSettings, index: int, target: NDArray[np.float64], rng: np.random.Generator
) -> Camera:
    """The camera with this number in the ring around a target.

    It aims a few metres off the target, leans by a fraction of a degree, has its principal point
    a few pixels off the middle and the mild barrel distortion (k1, k2) of a stadium lens (C5).

    Args:
        rig: distances, heights and picture.
        index: number in the ring.
        target: (3,) [m], world.
        rng: this camera's own.
    """
    azimuth = 2.0 * np.pi * (index * GOLDEN + rng.uniform(-0.02, 0.02)) - 0.5 * np.pi
    distance, height = rng.uniform(*rig.distance), rng.uniform(*rig.height)
    center = target + np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
    aim = target + np.array([*rng.uniform(-1.5, 1.5, 2), 0.5 * STANDARD_PERSON])
    # An upright person far below the camera is foreshortened by the cosine of the tilt.
    far = float(np.linalg.norm(aim - center))
    focal = rig.person_height * far / (STANDARD_PERSON * distance / far)
    width, tall = rig.image_size
    middle = np.array([width - 1.0, tall - 1.0]) / 2.0
    return Camera(
        focal=np.array([focal, focal]),
        principal_point=middle + 0.004 * width * rng.standard_normal(2),
        distortion=np.array([rng.uniform(-0.12, -0.02), rng.uniform(0.0, 0.03), 0.0, 0.0, 0.0]),
        cam_from_world=_looking(center, aim, np.radians(0.5) * rng.standard_normal()),
        image_size=np.array([width, tall]),
    )


def _looking(center: NDArray[np.float64], aim: NDArray[np.float64], roll: float) -> Rigid:
    """The pose of a camera at `center` that sees `aim` in its middle, rolled by an angle [rad]."""
    forward = (aim - center) / np.linalg.norm(aim - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ level
    return Rigid(rotation, -rotation @ center)
