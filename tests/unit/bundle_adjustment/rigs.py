"""Cameras around the origin, and how far they are from the true ones."""

import numpy as np
from camera_builders import look_at_camera

from worldpose.geometry.cameras import Camera


def rig(count, rng):
    """Cameras around the origin, 50 m away."""
    angles = 2.0 * np.pi * np.arange(count) / count + 0.3
    focal = rng.uniform(1800.0, 2400.0, count)
    middle = np.array([959.5, 539.5]) + rng.normal(0.0, 5.0, (count, 2))
    lens = (-0.08, 0.02, 0.0, 0.0, 0.0)
    return Camera.stack(
        [
            look_at_camera(
                *((50.0 * np.cos(angle), 50.0 * np.sin(angle), 15.0), (0.0, 0.0, 1.0), focal[n]),
                middle=middle[n],
                lens=lens,
                roll=0.01,
            )
            for n, angle in enumerate(angles)
        ]
    )


def errors(cameras, true):
    """Return the mean reprojection error [px] of people's positions per camera."""
    places = np.array([[x, y, 1.0] for x in (-8.0, 0.0, 8.0) for y in (-8.0, 0.0, 8.0)])
    return np.linalg.norm(cameras.project(places) - true.project(places), axis=-1).mean(axis=-1)
