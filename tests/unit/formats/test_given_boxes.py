"""Boxes of people in MOTChallenge's text, and people as a COCO data set."""

import numpy as np
import pytest
from camera_builders import plain_camera

from worldpose.errors import InputError
from worldpose.formats.annotations.marked_images import SOCCERNET_MARKINGS, read_marked_images
from worldpose.formats.detection_files import read_boxes
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import coco_dataset
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

SIZE = (640, 480)


@pytest.fixture
def read(tmp_path):
    def read_text(text, size=SIZE, frames=100):
        file = tmp_path / "left.txt"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_boxes(file, size, frames)

    return read_text


def test_lines_become_boxes_sorted_by_frame(read):
    found = read("2,7,11.5,21.5,10,20,0.9,-1,-1,-1\n\n1,3,1.5,1.5,4,8,-1,-1,-1,-1\r\n")
    assert (found.frame.tolist(), found.person.tolist()) == ([0, 1], [3, 7])
    # (1, 1) there is the corner of the first pixel, (0, 0) here its centre.
    np.testing.assert_allclose(found.box, [[0.0, 0.0, 4.0, 8.0], [10.0, 20.0, 20.0, 40.0]])
    np.testing.assert_allclose(found.score, [1.0, 0.9])


def test_boxes_outside_and_confidences_above_one_are_counted(read):
    found = read("1,1,10,10,5,5,1.26\n1,2,700,10,5,5,1\n2,1,630,10,20,5,1\n2,9,-9,1,5,5,0\n")
    assert (found.person.tolist(), found.score.tolist()) == ([1, 1], [1.0, 1.0])
    assert found.changes == (
        "1 boxes of confidence 0, which are left out",
        "1 boxes outside of the image, which are left out",
        "1 boxes of a confidence above 1, which counts as 1",
    )


@pytest.mark.parametrize(
    ("line", "people"),
    [
        *(("{},{}", 1), ("{},{},0,0", 2), ("{},0.5,7.25,0", 3), ("{},0,0,0", 3)),
        *(("{},{},7,0", 3), ("{},0,-1,-1", 3), ("{},{}00,50,0", 3)),
    ],
)
def test_classes_are_told_in_lines_of_any_length(read, line, people):
    lines = [f"1,{n},{50 * n},10,5,5,{line.format(1, n)}" for n in (1, 2, 4)]
    assert len(read("\n".join(lines)).person) == people


def test_right_and_bottom_are_not_width_and_height(read):
    with pytest.raises(InputError, match="are these right and bottom"):
        read("1,1,300,200,340,300,1\n2,1,400,200,440,300,1\n")
    assert len(read("1,1,300,200,340,200,1\n2,1,400,200,240,300,1\n").person) == 2
    for near in ("5,40,400,620", "-40,50,700,620"):  # whole bodies near the camera
        assert len(read(f"1,1,{near},1\n2,1,{near},1\n").person) == 2


def test_right_and_bottom_are_told_of_one_person_amid_the_image(read):
    def walk(right, bottom):
        return "\n".join(f"{n},1,{20 + 5 * n},50,{right(n)},{bottom(n)},1" for n in range(1, 31))

    with pytest.raises(InputError, match="are these right and bottom"):
        read(walk(lambda n: 60 + 5 * n, lambda n: 170 + n % 3), (1920, 1080))
    for width, height in (
        (lambda n: 180 + 3 * (n % 7), lambda _: 400),
        (lambda n: 80 + 5 * n, lambda _: 400),  # left edge and width grow together
        (lambda n: 80 + 5 * n, lambda n: 200 + 13 * n),  # and the height: the person comes nearer
    ):
        assert len(read(walk(width, height), (1920, 1080)).person) == 30
    lines = [f"{n},1,{5 + 2 * n},20,{60 + 2 * n},300,1" for n in range(1, 40)]
    assert len(read("\n".join(lines), (1920, 1080)).person) == 39


def test_lines_without_an_id_are_refused(read):
    for score in (1, 0.97):
        with pytest.raises(InputError, match=r"line 1: height: .* is the id missing"):
            read(f"1,300,200,40,90,{score}\n2,305,200,40,90,{score}\n")


def test_boxes_of_another_class_are_counted_and_minus_one_is_no_class(read):
    found = read("1,1,10,10,5,5,1,-1,-1\n1,2,30,10,5,5,1,1,1\n1,3,50,10,5,5,1,7,1\n")
    assert found.person.tolist() == [1, 2]
    assert found.changes == ("1 boxes of another class than 1, a person, which are left out",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected boxes, found an empty file"),
        (b"\x80\xff\x00" * 20, "expected text"),
        ("a,b,c,d,e,f\n", "line 1: expected numbers, found 'a,b,c,d,e,f'"),
        ("1,1,10,10,5,5,1\n\n1,1,x,10,5,5,1\n", "line 3: expected numbers"),
        ("1 1 10 10 5 5\n", "line 1: expected 6 to 10 numbers, separated by commas"),
        ("1,1,10,10,5,5,1\n2,1,10,10,5\n", "line 2: expected 7 numbers"),
        ("1,1,10,10,5,nan,1\n", "line 1: expected finite numbers"),
        ("0,1,10,10,5,5,1\n", "line 1: frame: expected a frame from 1 to 100.*begin at 0"),
        ("1,1,10,10,5,5,1\n101,1,10,10,5,5,1\n", "line 2: frame: expected a frame from 1 to 100"),
        ("1,1.5,10,10,5,5,1\n", "line 1: id: expected a whole number"),
        ("1,4,10,10,5,5,1\n1,4,50,10,5,5,1\n", "line 2: id: expected each id once in a frame"),
        ("1,1,10,10,0,5,1\n", "line 1: width, height: expected more than 0 px"),
        ("1,1,700,10,5,5,1\n", "line 1: left, .*: expected a box in the image of 640 x 480 px"),
        ("1,1,10,10,5,5,87\n", "line 1: confidence: expected 0 to 1"),
        ("1,1,9,9,5,5,1,0,-1\n", "expected a box of a person .* found 1 boxes, 1 of them of anoth"),
    ],
)
def test_a_bad_line_is_refused_with_its_number(read, text, message):
    with pytest.raises(InputError, match=message) as refused:
        read(text)
    assert "left.txt" in str(refused.value)


def test_boxes_of_an_array_have_its_rows_as_people(tmp_path):
    boxes = np.full((3, 2, 4), np.nan)
    boxes[0, 1], boxes[2, 0] = [10.0, 20.0, 30.0, 60.0], [1.5, 2.0, 8.0, 9.0]
    np.save(tmp_path / "clip.npy", boxes)
    given = read_boxes(tmp_path / "clip.npy", (1920, 1080), 3)
    assert (given.frame.tolist(), given.person.tolist()) == ([0, 2], [1, 0])
    np.testing.assert_array_equal(given.box, [boxes[0, 1], boxes[2, 0]])
    with pytest.raises(InputError, match=r"expected 4 frames"):
        read_boxes(tmp_path / "clip.npy", (1920, 1080), 4)


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
