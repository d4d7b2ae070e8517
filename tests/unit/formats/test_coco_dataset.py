import numpy as np
import pytest
from camera_builders import plain_camera

from worldpose.errors import InputError
from worldpose.formats.annotations.marked_images import SOCCERNET_MARKINGS, read_marked_images
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import coco_dataset
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate


@pytest.fixture
def camera():
    """Looks along world z from the origin: a point (x, y, 10) is at pixel (10x + 50, 10y + 40)."""
    return plain_camera(100.0, (50.0, 40.0), Rigid.identity(), (100, 80))


def missing():
    return np.full((17, 3), np.nan)


def two_joints():
    """Nose at pixel (50, 40), left eye at (60, 20)."""
    person = missing()
    person[0] = (0.0, 0.0, 10.0)
    person[1] = (1.0, -2.0, 10.0)
    return person


def dataset(camera, frames_of_people, observed=None, **more):
    joints = np.array(frames_of_people)
    tracks = JointTracks(np.arange(5, 5 + len(joints)), np.array([7, 3])[: joints.shape[1]], joints)
    if observed is None:
        observed = np.zeros(joints.shape[:3], dtype=bool)
    return coco_dataset("north", camera, tracks, observed, **more)


def test_annotation_of_two_joints(camera):
    observed = np.zeros((1, 1, 17), dtype=bool)
    observed[0, 0, 1] = True
    (annotation,) = dataset(camera, [[two_joints()]], observed)["annotations"]
    assert annotation == {
        "id": 1,
        "image_id": 5,
        "category_id": 1,
        "track_id": 7,
        "iscrowd": 0,
        "keypoints": [50.0, 40.0, 1, 60.0, 20.0, 2] + [0.0, 0.0, 0] * 15,
        "num_keypoints": 2,
        "bbox": [50.0, 20.0, 10.0, 20.0],
        "area": 200.0,
    }


def test_joints_outside_the_picture_and_behind_the_camera_are_not_labelled(camera):
    person = two_joints()
    person[2] = (4.949, 0.0, 10.0)  # u = 99.49: on the last pixel
    person[3] = (4.951, 0.0, 10.0)  # u = 99.51: beyond its edge
    person[4] = (0.0, 0.0, -10.0)
    observed = np.ones((1, 1, 17), dtype=bool)
    (annotation,) = dataset(camera, [[person]], observed)["annotations"]
    assert annotation["keypoints"][2::3] == [2, 2, 2] + [0] * 14
    assert annotation["keypoints"][9:15] == [0.0, 0.0, 0] * 2


def test_every_name_is_another_marking_of_the_template():
    ours = list(SOCCERNET_MARKINGS.values())
    assert len(ours) == len(set(ours)) == 26
    corners = {name for name in PitchTemplate.standard().marking_names if "corner" in name}
    assert set(ours) | corners == set(PitchTemplate.standard().marking_names)


def test_posts_are_named_as_seen_from_the_pitch():
    # Looking at the left goal (negative x) from the centre, the main camera's side is to the left.
    assert SOCCERNET_MARKINGS["Goal left post left"] == "goal_post_left_near"
    assert SOCCERNET_MARKINGS["Goal right post left"] == "goal_post_right_far"


def test_lines_in_pixels_are_named(tmp_path):
    file = tmp_path / "lines.json"
    file.write_text('{"Middle line": [{"x": 480.0, "y": 270.0}, {"x": 470.0, "y": 10.0}]}')
    with pytest.raises(InputError, match="Middle line: places in pixels"):
        read_marked_images(file)
