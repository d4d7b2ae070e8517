"""Cameras: static ones in a stadium's seats or in a ring, and the broadcast camera."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.pitch import PitchSpec
from worldpose.geometry import Camera, Rigid
from worldpose.simulation.random_processes import drift
from worldpose.simulation.settings import BroadcastSettings, RigSettings

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
        center, aim, focal = _place_in_ring(rig, index, target, pitch, rng)
    width, tall = rig.image_size
    middle = np.array([width - 1.0, tall - 1.0]) / 2.0
    return Camera(
        focal=np.array([focal, focal]),
        principal_point=middle + 0.004 * width * rng.standard_normal(2),
        distortion=np.array([rng.uniform(-0.12, -0.02), rng.uniform(0.0, 0.03), 0.0, 0.0, 0.0]),
        cam_from_world=look_at(center, aim, np.radians(0.5) * rng.standard_normal()),
        image_size=np.array([width, tall]),
    )


def _place_in_ring(
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


def look_at(center: NDArray[np.float64], aim: NDArray[np.float64], roll: float) -> Rigid:
    """Return the pose of a camera at `center` that looks at `aim`, rolled by an angle [rad]."""
    forward = (aim - center) / np.linalg.norm(aim - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ level
    return Rigid(rotation, -rotation @ center)


CALM: Final = 0.02
"""Time step of the operator's motion [s]: one frame at 50 per second."""
WARM_UP: Final = 1.5
"""Time for which the operator follows the action before the first frame [s]."""


def move_broadcast_camera(
    settings: BroadcastSettings,
    times: Floats,
    action: Floats,
    action_times: Floats,
    image_size: tuple[int, int],
    rng: np.random.Generator,
) -> Camera:
    """Return the broadcast camera of every frame, a batch (frames,), with one center (M1).

    Pan and tilt follow a smoothed action through two equal first-order lags, like a damped head;
    the zoom varies between wide and close. Radial distortion grows with the focal length, as in the
    released clips: k1 0.1 to 1, k2 0.6 to 4.3.

    Args:
        settings: place, zoom and operator.
        times: (frames,) [s].
        action: (samples, 2) [m], world; place of the action.
        action_times: (samples,) [s], from `WARM_UP` before the first frame to the last.
        image_size: width, height [px].
        rng: the camera's and the operator's own.
    """
    center = np.array(
        [
            rng.uniform(-settings.aside, settings.aside),
            -rng.uniform(*settings.setback),
            rng.uniform(*settings.height),
        ]
    )
    hand = np.arange(times[0] - WARM_UP, times[-1] + 2.0 * CALM, CALM)
    aim = np.stack([np.interp(hand, action_times, axis) for axis in action.T], axis=-1)
    aim[:, 0] += settings.sway * _smooth(drift(hand.shape, 2.5, 1.0 / CALM, rng), 0.6)
    aim[:, 0] += settings.sweep * np.sin(2.0 * np.pi * (hand / 8.0 + rng.random()))
    # The image centre stays within the pitch, nearer to the camera than the action's far side.
    aim = np.clip(0.9 * aim, [-40.0, -22.0], [40.0, 26.0])
    aim = _smooth(_smooth(aim, 0.5 * settings.lag), 0.5 * settings.lag)
    aim = np.stack([np.interp(times, hand, axis) for axis in aim.T], axis=-1)

    low, high = settings.focal
    period = rng.uniform(*settings.zoom_period)
    wave = np.sin(2.0 * np.pi * (times / period + rng.random()))
    focal = low * (high / low) ** (0.5 + 0.5 * wave)
    roll = np.radians(0.15) * rng.standard_normal()
    poses = [look_at(center, np.array([*point, 1.0]), roll) for point in aim]
    glass, width = rng.uniform(0.85, 1.15, 2), np.array(image_size, dtype=np.float64)
    zoomed = focal / 4200.0
    k1 = np.clip(0.42 * glass[0] * zoomed**1.6, 0.0, 1.0)
    k2 = np.clip(1.6 * glass[1] * zoomed, 0.0, 4.3)
    nothing = np.zeros_like(k1)
    offset = np.array([rng.uniform(-16.0, 12.0), rng.uniform(-60.0, -3.0)])
    return Camera(
        focal=np.stack([focal, focal], axis=-1),
        principal_point=np.broadcast_to((width - 1.0) / 2.0 + offset, (len(times), 2)),
        distortion=np.stack([k1, k2, nothing, nothing, nothing], axis=-1),
        cam_from_world=Rigid(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.translation for pose in poses]),
        ),
        image_size=np.array(image_size),
    )


def _smooth(signal: Floats, time: float) -> Floats:
    """Return a first-order lag along the first axis."""
    smoothed = np.empty_like(signal)
    keep = float(np.exp(-CALM / time))
    smoothed[0] = signal[0]
    for i in range(1, len(signal)):
        smoothed[i] = keep * smoothed[i - 1] + (1.0 - keep) * signal[i]
    return smoothed
