"""Pan, tilt and roll of cameras turned by known angles, and the picture of their course."""

import io

import matplotlib.image
import numpy as np
import pytest

from worldpose.cameras import Camera, Rigid
from worldpose.release.broadcast_pictures import angles_of, course_picture

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rows right, down and ahead of a camera that looks along y."""


def turned(pan=0.0, tilt=0.0, roll=0.0):
    """A camera turned by angles [deg]: first about its own axis, then up, then to the right."""
    pan, tilt, roll = np.radians([pan, tilt, roll])
    about_axis = Rigid.from_rotvec(np.array([0.0, 0.0, -roll]), np.zeros(3)).rotation
    up = Rigid.from_rotvec(np.array([-tilt, 0.0, 0.0]), np.zeros(3)).rotation
    aside = Rigid.from_rotvec(np.array([0.0, 0.0, pan]), np.zeros(3)).rotation
    return about_axis @ up @ LEVEL @ aside


def cameras(*rotations, missing=()):
    count = len(rotations)
    focal = np.full((count, 2), 4000.0)
    focal[list(missing)] = np.nan
    return Camera(
        focal=focal,
        principal_point=np.tile([959.5, 539.5], (count, 1)),
        distortion=np.zeros((count, 5)),
        cam_from_world=Rigid(np.stack(rotations), np.zeros((count, 3))),
        image_size=np.array([1920, 1080]),
    )


@pytest.mark.parametrize(
    ("pan", "tilt", "roll"), [(0, 0, 0), (20, 0, 0), (0, -15, 0), (0, 0, 3), (-40, -12, 1.5)]
)
def test_angles_are_those_that_the_camera_was_turned_by(pan, tilt, roll):
    found = np.concatenate(angles_of(cameras(turned(pan, tilt, roll))))
    np.testing.assert_allclose(found, [pan, tilt, roll], atol=1e-9)


def test_a_camera_panned_to_the_right_looks_towards_positive_x():
    ahead = turned(pan=30)[2]
    np.testing.assert_allclose(ahead, [0.5, np.sqrt(0.75), 0.0], atol=1e-12)


def test_the_course_is_drawn_also_where_frames_have_no_camera():
    moving = cameras(*(turned(pan) for pan in range(5)), missing=[2])
    covariance = np.tile(1e-6 * np.eye(7), (5, 1, 1))
    covariance[2] = np.nan
    picture = course_picture(np.arange(5), moving, covariance)
    assert matplotlib.image.imread(io.BytesIO(picture)).shape[:2] == (704, 1540)
