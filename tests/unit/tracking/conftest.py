"""Cameras on a ring round the origin, standing people, and what the cameras see of them."""

import numpy as np
import pytest
from camera_builders import ring_of_cameras

SKELETON = np.array(
    [
        *([0.10, 0.00, 1.65], [0.08, 0.03, 1.69], [0.08, -0.03, 1.69], [0.02, 0.07, 1.67]),
        *([0.02, -0.07, 1.67], [0.00, 0.18, 1.45], [0.00, -0.18, 1.45], [0.02, 0.25, 1.17]),
        *([0.02, -0.25, 1.17], [0.10, 0.27, 0.93], [0.10, -0.27, 0.93], [0.00, 0.13, 0.95]),
        *([0.00, -0.13, 0.95], [0.05, 0.13, 0.52], [0.05, -0.13, 0.52], [0.00, 0.13, 0.09]),
        [0.00, -0.13, 0.09],
    ]
)


@pytest.fixture
def ring():
    """Cameras 30 m from the origin, 6 to 9 m up, looking at it with 1500 px focal length."""

    lens = {"middle": (960.0, 540.0), "lens": (-0.1, 0.02, 0.0, 0.0, 0.0)}

    def build(count):
        angles = 2 * np.pi * (np.arange(count) + 0.3) / count
        up = 6.0 + np.arange(count) % 4
        return ring_of_cameras(angles, up, (0.0, 0.0, 0.0), 1500.0, **lens)

    return build


@pytest.fixture
def people():
    """Joints (..., 17, 3) of people who stand upright at ground places (..., 2)."""

    def build(places):
        places = np.asarray(places, dtype=float)
        ground = np.concatenate([places, np.zeros((*places.shape[:-1], 1))], axis=-1)
        return SKELETON + ground[..., None, :]

    return build


@pytest.fixture
def seen():
    """Keypoints and confidence of people (frames, persons, 17, 3): detection n is person n."""

    def build(camera, joints, noise=1.0, seed=0):
        frames, persons = joints.shape[:2]
        image = camera.project(joints.reshape(frames, 1, persons * 17, 3))
        keypoints = image.reshape(frames, -1, persons, 17, 2)
        keypoints += np.random.default_rng(seed).normal(0, noise, keypoints.shape)
        return keypoints, np.full(keypoints.shape[:-1], 0.9)

    return build
