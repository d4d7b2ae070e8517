"""Markings and people drawn over images, where their camera has them."""

import numpy as np
from camera_builders import look_at_camera

from data_contracts.conventions import COCO17
from data_contracts.pitch import PitchSpec
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.tables import Positions
from worldpose.geometry.cameras import Camera
from worldpose.reports.bodies import BodyTracks
from worldpose.reports.videos import MARGIN_M, PIXELS_PER_M, minimap_frames, overlay_frames

SIZE = (322, 182)


def camera(frames, focal=600.0):
    one = look_at_camera((0.0, -60.0, 20.0), (0.0, 0.0, 0.0), focal, SIZE)
    return Camera.stack([one] * frames)


def tracks(frames):
    joints = np.full((frames, 1, 17, 3), np.nan)
    # A bone of 2 m, upright, on the centre mark: from the left shoulder to the left elbow.
    joints[0, 0, 5], joints[0, 0, 7] = [4.0, 0.0, 0.0], [4.0, 0.0, 2.0]
    return JointTracks(
        frames=np.arange(10, 10 + frames),
        person_ids=np.array([3]),
        joints=joints,
        covariance=np.full((frames, 1, 17, 3, 3), np.nan),
        views=np.zeros((frames, 1, 17), dtype=np.int64),
    )


def drawn(frames, pitch=None, people=None, bodies=None, focal=600.0):
    black = [np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8) for _ in frames]
    people = tracks(2) if people is None else people
    return list(
        overlay_frames(black, camera(len(frames), focal), people, np.array(frames), pitch, bodies)
    )


def test_a_bone_is_where_the_camera_has_it():
    picture, before, after = drawn([10, 11, 300])
    assert picture.shape == (90, 160, 3)  # 161 x 91 loses a row and a column
    assert not before.any() and not after.any()  # people are drawn in their own frames only
    rows, columns = np.nonzero(picture.any(axis=-1))
    ends = camera(1)[0].project(np.array([[4.0, 0.0, 0.0], [4.0, 0.0, 2.0]]))
    low, high = 0.5 * ends.min(axis=0) - 0.25, 0.5 * ends.max(axis=0) - 0.25
    # A line one pixel wide with soft borders.
    np.testing.assert_allclose([columns.min(), rows.min()], low, atol=1.6)
    np.testing.assert_allclose([columns.max(), rows.max()], high, atol=1.6)


def standing(places, ids):
    """People at positions (persons, 2) [m] in frame 10 and absent in frame 11."""
    model = load_open_body()
    transl = np.full((2, len(ids), 3), np.nan)
    transl[0] = np.concatenate([places, np.full((len(ids), 1), 1.2)], axis=1)
    upright = np.tile([np.pi / 2, 0.0, 0.0], (2, len(ids), 1))
    poses = BodyParameters(np.zeros(10), upright, np.zeros(69), transl)
    frames, ids = np.array([10, 11]), np.array(ids)
    joints = fold_keypoints(model, COCO17)(poses)
    return JointTracks(frames, ids, joints), BodyTracks(frames, ids, poses, model)


CLOSE = 3000.0
"""Focal length [px] at which people are 40 px tall in the half image."""


def middle(place):
    """Pixel of a person's chest in the half-size image."""
    x, y = 0.5 * camera(1, CLOSE)[0].project(np.array([[*place, 1.35]]))[0] - 0.25
    return round(y), round(x)


def test_bodies_are_seen_through_and_replace_bones():
    people, bodies = standing([[0.0, 0.0]], [3])
    skin = drawn([10], people=people, bodies=bodies, focal=CLOSE)[0]
    bones = drawn([10], people=people, focal=CLOSE)[0]
    # Between the sides of the trunk there is no bone.
    assert bones[middle([0.0, 0.0])].max() == 0
    assert 40 < skin[middle([0.0, 0.0])].max() < 0.75 * 255
    assert not drawn([11], people=people, bodies=bodies, focal=CLOSE)[0].any()


def test_people_are_drawn_at_their_places_and_in_the_way_of_their_kind():
    xy = np.array([[[20.0, 10.0], [-20.0, -10.0]], [[np.nan, np.nan], [-20.0, -10.0]]])
    on_plane = np.array([[False, True], [False, True]])
    people = Positions(
        np.array([7, 8]),
        np.array([3, 4]),
        ["", "ann"],
        on_plane,
        xy,
        np.zeros((2, 2, 2, 2)),
        np.full(2, np.nan),
        np.ones((2, 2)),
    )
    first, second = minimap_frames(people, PitchSpec())
    assert first.shape == (780, 1150, 3) and first.dtype == np.uint8

    def colour(image, x, y):
        row = (34.0 + MARGIN_M - y) * PIXELS_PER_M
        return image[round(row), round((52.5 + MARGIN_M + x) * PIXELS_PER_M)].astype(int)

    grass = colour(second, 20.0, 10.0)
    assert np.abs(colour(first, 20.0, 10.0) - grass).max() > 50  # a disc is filled
    np.testing.assert_array_equal(colour(first, -20.0, -10.0), grass)  # a ring is not
    assert np.abs(colour(first, -20.8, -10.0) - grass).max() > 50
