"""Pan, tilt and roll of cameras rotated by known angles, and their plot."""

import io

import cv2
import matplotlib.image
import numpy as np
import pytest

from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.broadcast import (
    camera_angles,
    largest_pose_changes,
    plot_before_after,
    plot_camera_course,
    plot_flow,
)
from worldpose.reports.drawing import PALETTE

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
    ("pan", "tilt", "roll"), [(20, 0, 0), (0, -15, 0), (0, 0, 3), (-40, -12, 1.5)]
)
def test_angles_are_those_that_the_camera_was_turned_by(pan, tilt, roll):
    found = np.concatenate(camera_angles(cameras(turned(pan, tilt, roll))))
    np.testing.assert_allclose(found, [pan, tilt, roll], atol=1e-9)


def people(*places):
    """A still person at each position (x, y) [m] in two frames, joints between 0 and 1.7 m."""
    joints = np.empty((2, len(places), 17, 3))
    joints[..., :2] = np.array(places)[None, :, None]
    joints[..., 2] = np.linspace(-0.8, 0.9, 17)
    return JointTracks(np.arange(2), np.arange(len(places)), joints)


def test_whom_a_refinement_moves_most_is_shown_before_and_after():
    after = cameras(turned(), turned())
    # Half a degree in the second frame: all move by 35 px, who is aside by more.
    before = cameras(turned(), turned(tilt=0.5))
    # The third stands where the image ends, and is not shown.
    tracks = people((0.0, 80.0), (9.0, 80.0), (18.2, 80.0))
    assert largest_pose_changes(before, after, tracks) == (1, 1)
    assert largest_pose_changes(after, after, people((200.0, 80.0))) == (0, 0)
    still = np.full((1080, 1920, 3), 90, np.uint8)
    seen = after[1].project(tracks.joints[1])
    picture = plot_before_after(before[1], after[1], tracks, 1, 1, still=still, seen=seen)
    shown = matplotlib.image.imread(io.BytesIO(picture))[..., :3]
    # Skeletons are coloured on grey, and lie elsewhere in the two halves.
    colored = np.ptp(shown, axis=-1) > 0.3
    left, right = colored[:, :770], colored[:, 770:]
    assert left.any() and right.any()
    assert abs(np.nonzero(left)[0].mean() - np.nonzero(right)[0].mean()) > 50.0
    unseen = np.full_like(seen, np.nan)
    bare = plot_before_after(before[1], after[1], tracks, 1, 1, still=still, seen=unseen)
    crosses = np.abs(shown - matplotlib.image.imread(io.BytesIO(bare))[..., :3]).max(axis=-1) > 0.1
    # They are where the right half has its skeleton, and at the same place in the left one.
    rows = [np.nonzero(half)[0].mean() for half in (crosses[:, :770], crosses[:, 770:], right)]
    assert abs(rows[0] - rows[1]) < 5.0
    assert abs(rows[1] - rows[2]) < 30.0


def painted(png, color):
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    return int((np.abs(image.astype(int) - wanted) < 12).all(-1).sum())


def test_the_course_without_smoothing_lies_beneath_the_smoothed_one():
    moving = cameras(*(turned(pan) for pan in range(5)), missing=[2])
    rough = cameras(*(turned(pan + 0.3 * (-1) ** pan) for pan in range(5)))
    covariance = np.tile(1e-6 * np.eye(7), (5, 1, 1))
    covariance[2] = np.nan
    alone, both = (
        painted(plot_camera_course(np.arange(5), moving, covariance, before), PALETTE[1])
        for before in (None, rough)
    )
    assert alone == 0
    assert both > 100


def test_motion_is_drawn_with_what_was_rejected():
    start = np.array([[20.0, 20.0], [60.0, 40.0], [100.0, 60.0]])
    end = start + [4.0, 0.0]
    still = np.full((90, 160, 3), 40, np.uint8)
    counts = [
        [
            painted(plot_flow(still, start, end, np.array(rejected), end), color)
            for color in (PALETTE[5], PALETTE[1])
        ]
        for rejected in ([False] * 3, [False, True, True])
    ]
    # The legend names both, whether or not there are any.
    assert counts[0][0] > counts[1][0] > 0
    assert counts[1][1] > counts[0][1] > 0
