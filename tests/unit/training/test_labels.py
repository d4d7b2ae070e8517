import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from yolo_labels import read_yolo_labels

from worldpose.detection.interfaces import People
from worldpose.errors import InputError
from worldpose.training.labels import LabelledPicture, read_labels, write_labels
from worldpose.training.metrics import average_precision, correct_keypoints


@pytest.fixture
def picture(tmp_path):
    keypoints = np.arange(68.0).reshape(2, 17, 2)
    visible = np.full((2, 17), 2, dtype=np.int8)
    visible[0, 3], visible[1, 4] = 0, 1
    keypoints[0, 3] = np.nan
    return LabelledPicture(
        path=tmp_path / "a.jpg",
        boxes=np.array([[1.0, 2.0, 31.0, 62.0], [-0.5, -0.5, 8.0, 9.0]]),
        keypoints=keypoints,
        visible=visible,
        ignored=np.array([False, True]),
    )


def test_labels_come_back_as_they_were(tmp_path, picture):
    write_labels(tmp_path / "labels.json", [picture], (1920, 1080))
    (read,) = read_labels(tmp_path / "labels.json")
    assert read.path == picture.path
    fields = ("boxes", "keypoints", "visible", "ignored")
    for field in fields:
        np.testing.assert_array_equal(getattr(read, field), getattr(picture, field))
    nobody = replace(picture, **{field: getattr(picture, field)[:0] for field in fields})
    write_labels(tmp_path / "labels.json", [nobody], (1920, 1080))
    (read,) = read_labels(tmp_path / "labels.json")
    assert read.boxes.shape == (0, 4) and read.keypoints.shape == (0, 17, 2)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("annotations", {"keypoints": [1.0] * 50}),
        ("annotations", {"bbox": [float("nan"), 0.0, 1.0, 1.0]}),
        ("annotations", {"image_id": 99}),
        ("annotations", {"bbox": [9.0, 9.0, -1.0, 1.0]}),
        ("annotations", {"keypoints": [1.0, 1.0, 0.93] * 17}),
        ("annotations", {"category_id": 7}),
        ("images", {"width": 480}),
        ("categories", {"keypoints": ["nose", "left_foot"]}),
        ("images", {"file_name": "../../secret.jpg"}),
        ("images", {"id": None}),
    ],
)
def test_damaged_labels_are_refused(tmp_path, picture, part, change):
    cv2.imwrite(str(picture.path), np.zeros((108, 192, 3), dtype=np.uint8))
    file = tmp_path / "labels.json"
    write_labels(file, [picture], (192, 108))
    assert len(read_labels(file)) == 1
    dataset = json.loads(file.read_text())
    dataset[part][0] |= change
    file.write_text(json.dumps(dataset))
    with pytest.raises(InputError, match=r"labels\.json"):
        read_labels(file)
    dataset["images"] *= 2
    file.write_text(json.dumps(dataset))
    with pytest.raises(InputError, match=r"labels\.json"):
        read_labels(file)


def test_categories_say_who_is_a_person_and_in_which_order_joints_are(tmp_path, picture, caplog):
    file = tmp_path / "labels.json"
    write_labels(file, [picture], (1920, 1080))
    dataset = json.loads(file.read_text())
    dataset["categories"][0]["keypoints"].reverse()
    dataset["categories"].append({"id": 2, "name": "ball"})
    for person in dataset["annotations"]:
        triples = np.reshape(person["keypoints"], (17, 3))[::-1]
        person["keypoints"] = triples.ravel().tolist()
    ball = {"id": 9, "image_id": 0, "category_id": 2, "bbox": [1, 1, 8, 8], "iscrowd": 0}
    dataset["annotations"].append(ball)
    file.write_text(json.dumps(dataset))
    (read,) = read_labels(file)
    np.testing.assert_array_equal(read.keypoints, picture.keypoints)
    assert "left out 1 annotations" in caplog.text


def test_yolo_labels_of_boxes_and_polygons(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((100, 200, 3), dtype=np.uint8))
    (tmp_path / "a.txt").write_text(
        "0 0.5 0.5 0.1 0.4\n\n0 0.1 0.2 0.15 0.2 0.125 0.6\n1 0.5 0.5 0.01 0.01\n"
    )
    labels = read_yolo_labels(tmp_path / "a.png")
    # Pixel corners 90 to 110 and 30 to 70; a pixel's centre is half a pixel from its corner.
    expected = [[89.5, 29.5, 109.5, 69.5], [19.5, 19.5, 29.5, 59.5]]
    np.testing.assert_allclose(labels.boxes, expected, atol=1e-9)
    assert labels.keypoints.shape == (2, 17, 2) and not labels.ignored.any()
    assert len(read_yolo_labels(tmp_path / "a.png", person=1).boxes) == 1
    (tmp_path / "a.txt").write_text("")
    assert read_yolo_labels(tmp_path / "a.png").boxes.shape == (0, 4)


@pytest.mark.parametrize("line", ["0 0.5 0.5", "0 0.5 0.5 0.1 high", "person 0.5 0.5 0.1 0.1"])
def test_damaged_yolo_labels_name_file_and_line(tmp_path, line):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((100, 200, 3), dtype=np.uint8))
    (tmp_path / "a.txt").write_text(f"0 0.5 0.5 0.1 0.1\n{line}\n")
    with pytest.raises(InputError, match=r"a\.txt.*line 2"):
        read_yolo_labels(tmp_path / "a.png")


def truth(boxes, ignored=None):
    boxes = np.array(boxes, dtype=float).reshape(-1, 4)
    count = len(boxes)
    return LabelledPicture(
        path=Path("none.jpg"),
        boxes=boxes,
        keypoints=np.full((count, 17, 2), np.nan),
        visible=np.zeros((count, 17), dtype=np.int8),
        ignored=np.array([False] * count if ignored is None else ignored, dtype=bool),
    )


def found(boxes, scores):
    return People(np.array(boxes, dtype=float).reshape(-1, 4), np.array(scores, dtype=float))


NEAR, FAR, AWAY = [0, 0, 20, 40], [100, 0, 120, 40], [300, 0, 320, 40]


@pytest.mark.parametrize(
    ("boxes", "people", "area"),
    [
        # Precision 1 at recall 1/2, 2/3 at recall 1: the area is 1/2 * 1 + 1/2 * 2/3.
        ([NEAR, AWAY, FAR], [NEAR, FAR], 5 / 6),
        # The second box on a person is false, though it would be right alone.
        ([NEAR, NEAR, FAR], [NEAR, FAR], 5 / 6),
        # 20 x 40 boxes shifted along x by s overlap by (20 - s) / (20 + s): 0.5 at 20 / 3.
        ([[6.6, 0, 26.6, 40]], [NEAR], 1.0),
        ([[6.7, 0, 26.7, 40]], [NEAR], 0.0),
        ([NEAR], [], np.nan),
    ],
)
def test_area_under_precision_over_recall(boxes, people, area):
    said = found(boxes, [0.9, 0.8, 0.7][: len(boxes)])
    assert average_precision([said], [truth(people)]) == pytest.approx(area, nan_ok=True)


def test_a_keypoint_within_a_fifth_of_the_torso_is_correct():
    # Shoulders 40 px apart, 30 px above both hips, which are on one point: a torso of 50 px.
    person = np.zeros((1, 17, 2))
    person[0, 5], person[0, 6] = (40.0, 0.0), (0.0, 0.0)
    person[0, 11] = person[0, 12] = (0.0, 30.0)
    found = person.copy()
    found[0, 0, 0] = 10.0
    found[0, 11, 1] += 10.01
    found[0, 9], person[0, 10] = np.nan, np.nan
    correct = correct_keypoints(found, person)
    assert np.isnan(correct[0, 10])
    assert np.flatnonzero(correct[0] == 0.0).tolist() == [9, 11]
