"""Poses of the static cameras: in a stadium's seats, or in a ring off the pitch."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.pitch import PitchSpec
from worldpose.geometry import Camera, Rigid
from worldpose.simulation.settings import RigSettings

STANDARD_PERSON: Final = 1.8
"""Body height for `RigSettings.person_height` [m]."""

GOLDEN: Final = (np.sqrt(5.0) - 1.0) / 2.0
"""Steps of this share of a turn spread any number of cameras, and an additional one moves none."""


def place_camera(
    rig: RigSettings,
    index: int,
    target: NDArray[np.float64],
    pitch: PitchSpec,
    rng: np.random.Generator,
) -> Camera:
    """Return the static camera with this number.

    It has its seat's place, aim and focal length with small random offsets; without a seat, it is
    in a ring around the target beyond the pitch border. It has a roll of a fraction of a degree, a
    principal point a few pixels off the centre and the mild barrel distortion (k1, k2) of a stadium
    lens (C5).

    Args:
        rig: seats, distances, heights and image size.
        index: number from 0.
        target: (3,) [m], world; aim of the ring.
        pitch: off which the ring's cameras stand.
        rng: this camera's own.
    """
    if index < len(rig.seats):
        seat = rig.seats[index]
        center = np.array(seat.place) + rig.seat_spread * rng.uniform(-1.0, 1.0, 3)
        aim = np.array([*seat.aim, 0.0])
        aim[:2] += rig.seat_spread * rng.uniform(-1.0, 1.0, 2)
        focal = seat.focal * rng.uniform(0.99, 1.01)
    else:
        center, aim, focal = _in_the_ring(rig, index, target, pitch, rng)
    width, tall = rig.image_size
    middle = np.array([width - 1.0, tall - 1.0]) / 2.0
    return Camera(
        focal=np.array([focal, focal]),
        principal_point=middle + 0.004 * width * rng.standard_normal(2),
        distortion=np.array([rng.uniform(-0.12, -0.02), rng.uniform(0.0, 0.03), 0.0, 0.0, 0.0]),
        cam_from_world=looking(center, aim, np.radians(0.5) * rng.standard_normal()),
        image_size=np.array([width, tall]),
    )


def _in_the_ring(
    rig: RigSettings,
    index: int,
    target: NDArray[np.float64],
    pitch: PitchSpec,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return center and aim (3,) [m], world, and focal length [px]."""
    azimuth = 2.0 * np.pi * (index * GOLDEN + rng.uniform(-0.02, 0.02)) - 0.5 * np.pi
    way = np.array([np.cos(azimuth), np.sin(azimuth)])
    border = 0.5 * np.array([pitch.length, pitch.width])
    to_border = float(np.min((border - np.sign(way) * target[:2]) / np.abs(way)))
    distance = to_border + rng.uniform(*rig.distance)
    center = target + np.array([*(distance * way), rng.uniform(*rig.height)])
    aim = target + np.array([*rng.uniform(-1.5, 1.5, 2), 0.5 * STANDARD_PERSON])
    # An upright person far below the camera is foreshortened by the cosine of the tilt.
    far = float(np.linalg.norm(aim - center))
    return center, aim, rig.person_height * far / (STANDARD_PERSON * distance / far)


def looking(center: NDArray[np.float64], aim: NDArray[np.float64], roll: float) -> Rigid:
    """Return the pose of a camera at `center` that looks at `aim`, rolled by an angle [rad]."""
    forward = (aim - center) / np.linalg.norm(aim - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ level
    return Rigid(rotation, -rotation @ center)
