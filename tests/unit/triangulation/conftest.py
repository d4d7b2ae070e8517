"""Cameras on a ring round the origin, and views of known joints."""

from collections.abc import Callable

import numpy as np
import pytest

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid


def look_at(center: np.ndarray, target: np.ndarray) -> Rigid:
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Rigid(rotation, -rotation @ center)


@pytest.fixture
def ring() -> Callable[..., Camera]:
    """Cameras 30 m from the origin, 8 m up, 1500 px focal length, with distortion."""

    def build(count: int, arc: float = 2 * np.pi) -> Camera:
        cameras = []
        for n in range(count):
            angle = arc * n / count
            center = np.array([30 * np.cos(angle), 30 * np.sin(angle), 8.0])
            cameras.append(
                Camera(
                    focal=np.array([1500.0, 1520.0]),
                    principal_point=np.array([950.0, 545.0]),
                    distortion=np.array([-0.1, 0.03, 0.001, -0.002, 0.0]),
                    cam_from_world=look_at(center, np.array([0.0, 0.0, 1.0])),
                    image_size=np.array([1920, 1080]),
                )
            )
        return Camera.stack(cameras)

    return build


@pytest.fixture
def seen() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Keypoints, confidence and detection index of joints (frames, persons, joints, 3)."""

    def build(camera: Camera, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        frames, persons, count, _ = joints.shape
        image = camera.project(joints.reshape(frames, 1, persons * count, 3))
        keypoints = image.reshape(frames, -1, persons, count, 2)
        confidence = np.ones(keypoints.shape[:-1])
        index = np.broadcast_to(np.arange(persons, dtype=np.int16), confidence.shape[:3]).copy()
        return keypoints, confidence, index

    return build
