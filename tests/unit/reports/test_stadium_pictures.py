import cv2
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.clips import (
    VIEW_LENGTH_M,
    plot_camera_view,
    plot_paths,
    plot_stadium,
    visible_ground,
)
from worldpose.reports.drawing import PALETTE
from worldpose.reports.static_cameras import ACCEPTED, REFUSED, Click, ErrorMap, plot_calibration


def decoded(png):
    image = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    return image[:, :, ::-1].astype(int)


def pixels_of(image, color):
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return np.argwhere(np.abs(image - wanted).max(axis=-1) <= 2)


def looking(down, height=20.0):
    """Stands at y = -50, looks along y and down by an angle, x to the right; 90 degrees wide."""
    c, s = np.cos(down), np.sin(down)
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, -s, -c], [0.0, c, -s]])
    return Camera(
        focal=np.array([960.0, 960.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, -rotation @ np.array([0.0, -50.0, height])),
        image_size=np.array([1920, 1080]),
    )


@pytest.fixture
def people():
    """Person 0 stands at the far left, person 1 at the near right."""
    joints = np.zeros((1, 2, 17, 3))
    joints[0, 0] += (-20.0, 20.0, 1.0)
    joints[0, 1] += (20.0, -20.0, 1.0)
    return JointTracks(np.arange(1), np.arange(2), joints)


def test_straight_down_the_ground_is_the_picture_s_rectangle():
    # 20 m up, focal length 960 px: a pixel is 20 / 960 m.
    corners = visible_ground(looking(np.pi / 2))
    np.testing.assert_allclose(corners.min(axis=0), [-20.0, -50.0 - 11.25], atol=1e-9)
    np.testing.assert_allclose(corners.max(axis=0), [20.0, -50.0 + 11.25], atol=1e-9)


def test_over_the_horizon_the_ground_ends_at_the_reach():
    corners = visible_ground(looking(0.0))
    assert np.isfinite(corners).all()
    far = np.linalg.norm(corners - (0.0, -50.0), axis=-1)
    assert far.max() == pytest.approx(VIEW_LENGTH_M)
    # The lower edge looks down by atan(540 / 960): 20 m up that is 35.6 m away, straight ahead.
    assert far.min() == pytest.approx(20.0 * 960.0 / 540.0, rel=0.01)


def test_from_above_people_are_where_they_are_and_near_is_below(people):
    png = plot_stadium({"south": looking(0.3)}, "frame 0", people, pitch=PitchSpec())
    far, near = (pixels_of(decoded(png), color).mean(axis=0) for color in PALETTE[:2])
    assert far[0] < near[0] - 100  # rows run down
    assert far[1] < near[1] - 100


def test_a_camera_s_picture_has_its_still_beneath(people):
    still = np.full((1080, 1920, 3), (10, 200, 30), dtype=np.uint8)
    with_still = decoded(plot_camera_view(looking(0.3), "south", people, 0, still=still))
    without = decoded(plot_camera_view(looking(0.3), "south", people, 0, pitch=PitchSpec()))
    assert len(pixels_of(with_still, "#0ac81e")) > 0.8 * with_still[..., 0].size
    assert len(pixels_of(without, "#0ac81e")) == 0
    for image in (with_still, without):
        far, near = (pixels_of(image, color).mean(axis=0) for color in PALETTE[:2])
        assert far[0] < near[0] - 20
        assert far[1] < near[1] - 100


def test_nobody_and_no_pitch_are_still_pictures():
    nobody = JointTracks(np.arange(1), np.arange(0), np.empty((1, 0, 17, 3)))
    assert decoded(plot_stadium({"a": looking(0.3)}, "", nobody)).shape[2] == 3
    assert decoded(plot_camera_view(looking(0.3), "", nobody, 0)).shape[2] == 3
    nobody = JointTracks(np.arange(0), np.arange(0), np.empty((0, 0, 17, 3)))
    assert decoded(plot_paths(nobody)).shape[2] == 3
    gone = JointTracks(np.arange(3), np.arange(1), np.full((3, 1, 17, 3), np.nan))
    assert decoded(plot_paths(gone, cameras={"south": looking(0.0)})).shape[2] == 3


def test_wrong_clicks_are_marked_where_they_were_made():
    clicks = [
        Click("corner_left_far", np.array([480.0, 270.0]), inlier=True),
        Click("corner_right_near", np.array([1440.0, 810.0]), inlier=False),
    ]
    image = decoded(plot_calibration(looking(0.3), "south", PitchSpec(), clicks=clicks))
    accepted = pixels_of(image, ACCEPTED).mean(axis=0)
    refused = np.median(pixels_of(image, REFUSED), axis=0)
    assert accepted[1] / image.shape[1] == pytest.approx(0.25, abs=0.02)
    assert accepted[0] < refused[0] - 300
    assert accepted[1] < refused[1] - 300


def test_the_coverage_map_is_added_below_and_has_the_same_bytes_every_time():
    x, y = np.linspace(-54.0, 54.0, 10), np.linspace(-36.0, 36.0, 7)
    expected = np.full((7, 10), 0.02)
    expected[:, :3] = np.nan
    error_map = ErrorMap(x, y, expected)
    pictures = [
        plot_calibration(looking(0.3), "south", PitchSpec(), error_map=each)
        for each in (None, error_map, error_map)
    ]
    heights = [decoded(png).shape[0] for png in pictures]
    assert heights[1] > heights[0] + 300
    assert pictures[1] == pictures[2]


def walkers():
    """Person 0 walks along x at y = 5, person 1 along x at y = -5; 2 m in 20 frames."""
    joints = np.zeros((20, 2, 17, 3))
    joints[..., 0] += np.linspace(0.0, 2.0, 20)[:, None, None]
    joints[:, 0, :, 1], joints[:, 1, :, 1] = 5.0, -5.0
    return JointTracks(np.arange(20), np.arange(2), joints)


def test_from_above_y_points_up_and_both_people_are_there():
    image = decoded(plot_paths(walkers(), cameras={"south": looking(0.0)}, pitch=PitchSpec()))
    close_up = image[:, image.shape[1] // 2 :]
    rows = [np.median(pixels_of(close_up, color)[:, 0]) for color in PALETTE[:2]]
    assert rows[0] < rows[1] - 100


def test_truth_is_drawn_beneath():
    tracks = walkers()
    alone, with_truth = (decoded(plot_paths(tracks, truth=t)) for t in (None, tracks))
    assert len(pixels_of(with_truth, "#cfcfcf")) > len(pixels_of(alone, "#cfcfcf")) + 100
