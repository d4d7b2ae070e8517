import cv2
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.clips import plot_paths
from worldpose.reports.drawing import PALETTE


def decoded(png):
    image = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    return image[:, :, ::-1].astype(int)


def pixels_of(image, color):
    """Rows and columns painted in a colour of the palette."""
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return np.argwhere(np.abs(image - wanted).max(axis=-1) <= 2)


def walkers():
    """Person 0 walks along x at y = 5, person 1 along x at y = -5; 2 m in 20 frames."""
    joints = np.zeros((20, 2, 17, 3))
    joints[..., 0] += np.linspace(0.0, 2.0, 20)[:, None, None]
    joints[:, 0, :, 1], joints[:, 1, :, 1] = 5.0, -5.0
    return JointTracks(np.arange(20), np.arange(2), joints)


@pytest.fixture
def camera():
    """Stands at y = -50, looks along y, x to the right, z up."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return Camera(
        focal=np.array([2000.0, 2000.0]),
        principal_point=np.array([960.0, 540.0]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, -rotation @ np.array([0.0, -50.0, 1.0])),
        image_size=np.array([1920, 1080]),
    )


def test_from_above_y_points_up_and_both_people_are_there(camera):
    image = decoded(plot_paths(walkers(), cameras={"south": camera}, pitch=PitchSpec()))
    close_up = image[:, image.shape[1] // 2 :]
    rows = [np.median(pixels_of(close_up, color)[:, 0]) for color in PALETTE[:2]]
    assert rows[0] < rows[1] - 100


def test_from_above_a_metre_is_as_long_up_as_across():
    tracks = walkers()
    joints = np.zeros((2, 2, 17, 3))
    joints[1, 0, :, 0] = 4.0  # person 0 goes 4 m along x
    joints[:, 1, :, 0] = -3.0
    joints[1, 1, :, 1] = 4.0  # person 1 goes 4 m along y
    image = decoded(plot_paths(JointTracks(np.arange(2), tracks.person_ids, joints)))
    close_up = image[:, image.shape[1] // 2 :]
    across, up = pixels_of(close_up, PALETTE[0]), pixels_of(close_up, PALETTE[1])
    # The extents hold the same dots and labels; a glyph may differ by a few pixels.
    assert np.ptp(across[:, 1]) == pytest.approx(np.ptp(up[:, 0]), abs=15)
    assert np.ptp(across[:, 1]) > 100


def test_truth_is_drawn_beneath(camera):
    tracks = walkers()
    alone, with_truth = (decoded(plot_paths(tracks, truth=t)) for t in (None, tracks))
    assert len(pixels_of(with_truth, "#cfcfcf")) > len(pixels_of(alone, "#cfcfcf")) + 100


def test_pictures_have_the_same_bytes_every_time(camera):
    tracks = walkers()
    assert plot_paths(tracks, truth=tracks) == plot_paths(tracks, truth=tracks)


def test_nobody_at_all_is_still_a_picture(camera):
    nobody = JointTracks(np.arange(0), np.arange(0), np.empty((0, 0, 17, 3)))
    assert decoded(plot_paths(nobody)).shape[2] == 3
    gone = JointTracks(np.arange(3), np.arange(1), np.full((3, 1, 17, 3), np.nan))
    assert decoded(plot_paths(gone, cameras={"south": camera})).shape[2] == 3
