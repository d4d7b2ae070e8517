import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from yolo_labels import read_yolo_labels

from worldpose.errors import InputError
from worldpose.training.labels import LabelledPicture, read_labels, write_labels


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
        ("images", {"file_name": "../../secret.jpg"}),
        ("images", {"id": None}),
    ],
)
def test_damaged_labels_are_refused(tmp_path, picture, part, change):
    file = tmp_path / "labels.json"
    write_labels(file, [picture], (1920, 1080))
    dataset = json.loads(file.read_text())
    dataset[part][0] |= change
    file.write_text(json.dumps(dataset))
    with pytest.raises(InputError, match=r"labels\.json"):
        read_labels(file)


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
