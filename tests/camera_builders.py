"""Cameras of tests, by where they stand and what they look at."""

import numpy as np

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid


def look_at_camera(
    center, aim, focal, size=(1920, 1080), *, middle=None, lens=(0.0,) * 5, roll=0.0
):
    """Return a camera at a place [m] that has another at its principal point, with a level horizon.

    Args:
        center: of the camera (3,) [m].
        aim: what it looks at (3,) [m].
        focal: length [px], or two of them.
        size: of the image [px].
        middle: principal point [px]; None = the middle of the image.
        lens: OpenCV's five coefficients.
        roll: about the line of sight [rad].
    """
    center, aim = np.array(center, dtype=float), np.array(aim, dtype=float)
    forward = (aim - center) / np.linalg.norm(aim - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    rotation = Rigid.from_rotvec(np.array([0.0, 0.0, roll]), np.zeros(3)).rotation @ level
    middle = 0.5 * (np.array(size) - 1.0) if middle is None else middle
    focal = np.broadcast_to(np.array(focal, dtype=float), 2)
    pose = Rigid(rotation, -rotation @ center)
    return Camera(focal, np.array(middle), np.array(lens), pose, np.array(size))


def ring_of_cameras(angles, up, aim, focal, *, away=30.0, **more):
    """Return cameras at angles (n,) [rad] around the origin, one or n heights [m] up."""
    places = [
        (away * np.cos(angle), away * np.sin(angle), height)
        for angle, height in zip(angles, np.broadcast_to(up, len(angles)), strict=True)
    ]
    return Camera.stack([look_at_camera(place, aim, focal, **more) for place in places])


def plain_camera(focal, middle, pose, size=(1920, 1080), *, lens=(0.0,) * 5):
    """Return the cameras of focal lengths (...,) [px] and their poses, with square pixels."""
    focal = np.repeat(np.array(focal, dtype=float)[..., None], 2, axis=-1)
    return Camera(focal, np.array(middle), np.array(lens), pose, np.array(size))
