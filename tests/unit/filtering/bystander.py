"""People in front of one camera, by hand: all expected positions are arithmetic."""

import numpy as np
from camera_builders import plain_camera

from worldpose.filtering.judging import BodyViews, Spread, view_bodies
from worldpose.filtering.redetection import Expected
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

FOCAL, SIZE = 1000.0, (1000, 600)
AWAY = 20.0
"""Of the place (0, 0) from the camera [m]: a metre is 50 px there."""
NOISE = (1.0, 0.02)

STANDING = np.array(
    [
        *([0.0, 1.60], [0.03, 1.63], [-0.03, 1.63], [0.07, 1.62], [-0.07, 1.62]),
        *([0.20, 1.40], [-0.20, 1.40], [0.30, 1.15], [-0.30, 1.15], [0.33, 0.90], [-0.33, 0.90]),
        *([0.12, 0.95], [-0.12, 0.95], [0.14, 0.50], [-0.14, 0.50], [0.15, 0.10], [-0.15, 0.10]),
    ]
)
"""To the left and up [m], of who faces the camera."""


def camera():
    """At (0, -20, 1), level, looking along y."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return plain_camera(FOCAL, (499.5, 299.5), Rigid(rotation, np.array([0.0, 1.0, AWAY])), SIZE)


def standing(*places):
    """Joints (1, persons, 17, 3) of people who stand at (x, y) [m]."""
    joints = np.empty((1, len(places), 17, 3))
    for joint, (x, y) in zip(joints[0], places, strict=True):
        joint[:, 0] = x + STANDING[:, 0]
        joint[:, 1] = y
        joint[:, 2] = STANDING[:, 1]
    return joints


def expected(*places, deviation=0.02):
    """Expected view of them in one frame."""
    joints = standing(*places)
    covariance = np.broadcast_to(np.eye(3) * deviation**2, (*joints.shape[:3], 3, 3))
    views: BodyViews = view_bodies(Camera.stack([camera()]), joints, covariance)
    return Expected.of(views, np.zeros((*joints.shape[:3], 2)), FOCAL)


def as_stated():
    """Keypoints that err as their detector says."""
    return Spread(np.ones(17), np.empty(0), np.ones(1))
