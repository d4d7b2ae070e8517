"""Markings and people drawn over pictures, where their camera has them."""

import numpy as np

from data_contracts.pitch import PitchSpec
from worldpose.cameras import Camera
from worldpose.release import JointTracks
from worldpose.release.overlay_video import overlay_frames
from worldpose.synthetic.stadium import looking

SIZE = (322, 182)


def camera(frames):
    pose = looking(np.array([0.0, -60.0, 20.0]), np.array([0.0, 0.0, 0.0]), 0.0)
    one = Camera(
        focal=np.array([600.0, 600.0]),
        principal_point=np.array([160.5, 90.5]),
        distortion=np.zeros(5),
        cam_from_world=pose,
        image_size=np.array(SIZE),
    )
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


def drawn(frames, pitch=None, people=None):
    black = [np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8) for _ in frames]
    people = tracks(2) if people is None else people
    return list(overlay_frames(black, camera(len(frames)), people, np.array(frames), pitch))


def test_pictures_have_half_the_size_and_even_sides():
    # 161 x 91 loses a row and a column.
    assert [picture.shape for picture in drawn([10, 11])] == [(90, 160, 3)] * 2


def test_a_bone_is_where_the_camera_has_it():
    picture = drawn([10])[0]
    rows, columns = np.nonzero(picture.any(axis=-1))
    ends = camera(1)[0].project(np.array([[4.0, 0.0, 0.0], [4.0, 0.0, 2.0]]))
    low, high = 0.5 * ends.min(axis=0) - 0.25, 0.5 * ends.max(axis=0) - 0.25
    # A line one pixel wide with soft borders.
    np.testing.assert_allclose([columns.min(), rows.min()], low, atol=1.6)
    np.testing.assert_allclose([columns.max(), rows.max()], high, atol=1.6)


def test_people_are_drawn_in_their_own_frames_only():
    assert not drawn([11])[0].any()
    assert not drawn([300])[0].any()


def test_markings_are_drawn_where_there_is_a_pitch():
    picture = drawn([11], pitch=PitchSpec())[0]
    mark = 0.5 * camera(1)[0].project(np.array([[0.0, 5.0, 0.0]]))[0] - 0.25
    # The halfway line, 5 m beyond the centre mark.
    x, y = np.rint(mark).astype(int)
    assert picture[y - 1 : y + 2, x - 1 : x + 2].any()
