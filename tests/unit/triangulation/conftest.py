"""Cameras on a ring round the origin, and views of known joints."""

import numpy as np
import pytest
from camera_builders import look_at_camera

from worldpose.geometry.cameras import Camera


@pytest.fixture
def ring():
    """Cameras 30 m from the origin, 8 m up, 1500 px focal length, with distortion."""

    def build(count, arc=2 * np.pi):
        cameras = []
        for n in range(count):
            angle = arc * n / count
            center = [30 * np.cos(angle), 30 * np.sin(angle), 8.0]
            cameras.append(
                look_at_camera(
                    *(center, (0.0, 0.0, 1.0), (1500.0, 1520.0)),
                    middle=(950.0, 545.0),
                    lens=(-0.1, 0.03, 0.001, -0.002, 0.0),
                )
            )
        return Camera.stack(cameras)

    return build


@pytest.fixture
def seen():
    """Keypoints, confidence and detection index of joints (frames, persons, joints, 3)."""

    def build(camera, joints):
        frames, persons, count, _ = joints.shape
        image = camera.project(joints.reshape(frames, 1, persons * count, 3))
        keypoints = image.reshape(frames, -1, persons, count, 2)
        confidence = np.ones(keypoints.shape[:-1])
        index = np.broadcast_to(np.arange(persons, dtype=np.int16), confidence.shape[:3]).copy()
        return keypoints, confidence, index

    return build
