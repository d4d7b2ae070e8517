"""Pan, tilt and roll of cameras, as broadcast camera data state them."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry.cameras import Camera


def camera_angles(camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Return pan, tilt and roll (frames,) of a camera (frames,) [deg].

    Pan is from the world's y axis towards x, tilt from the horizon upwards, roll clockwise about
    the view: a camera that rolls so shows a horizon that turns the other way.
    """
    right, down, ahead = np.moveaxis(camera.cam_from_world.rotation, 1, 0)
    pan = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    tilt = np.degrees(np.arcsin(np.clip(ahead[:, 2], -1.0, 1.0)))
    roll = np.degrees(np.arctan2(-right[:, 2], -down[:, 2]))
    return pan, tilt, roll


def rotation_of_angles(pan: Floats, tilt: Floats, roll: Floats) -> Floats:
    """Return the rotations (frames, 3, 3) of x_cam = R (x_world - center) from angles [deg].

    It is the inverse of `camera_angles`: FreeD's angles (frames,) in a world with z up.
    """
    (p, t, r) = np.radians([pan, tilt, roll])
    level = np.stack([np.cos(p), -np.sin(p), 0.0 * p], axis=-1)
    ahead = np.stack([np.sin(p) * np.cos(t), np.cos(p) * np.cos(t), np.sin(t)], axis=-1)
    down = np.cross(ahead, level)
    cosine, sine = np.cos(r)[:, None], np.sin(r)[:, None]
    return np.stack([cosine * level + sine * down, cosine * down - sine * level, ahead], axis=1)
