"""Cameras on a ring round the origin."""

import numpy as np
import pytest
from camera_builders import ring_of_cameras


@pytest.fixture
def ring():
    """Cameras 30 m from the origin, 8 m up, 1500 px focal length, with distortion."""
    lens = {"middle": (950.0, 545.0), "lens": (-0.1, 0.03, 0.001, -0.002, 0.0)}

    def build(count, arc=2 * np.pi):
        angles = arc * np.arange(count) / count
        return ring_of_cameras(angles, 8.0, (0.0, 0.0, 1.0), (1500.0, 1520.0), **lens)

    return build
