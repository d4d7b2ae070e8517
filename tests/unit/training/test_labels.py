import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.training.labels import LabelledPicture, read_labels, read_yolo_labels, write_labels


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
    for field in ("boxes", "keypoints", "visible", "ignored"):
        np.testing.assert_array_equal(getattr(read, field), getattr(picture, field))


def test_a_picture_of_nobody_stays(tmp_path):
    empty = LabelledPicture(
        tmp_path / "a.jpg",
        np.empty((0, 4)),
        np.empty((0, 17, 2)),
        np.empty((0, 17), dtype=np.int8),
        np.empty(0, dtype=bool),
    )
    write_labels(tmp_path / "labels.json", [empty], (1920, 1080))
    (read,) = read_labels(tmp_path / "labels.json")
    assert read.boxes.shape == (0, 4) and read.keypoints.shape == (0, 17, 2)


def _damaged(dataset, how):
    if how == "keypoints":
        dataset["annotations"][0]["keypoints"] = [1.0] * 50
    elif how == "number":
        dataset["annotations"][0]["bbox"][0] = float("nan")
    elif how == "image":
        dataset["annotations"][0]["image_id"] = 99
    elif how == "images":
        del dataset["images"]
    else:
        dataset["images"][0]["file_name"] = "../../secret.jpg"
    return dataset


@pytest.mark.parametrize("how", ["keypoints", "number", "image", "images", "path"])
def test_damaged_labels_are_refused(tmp_path, picture, how):
    file: Path = tmp_path / "labels.json"
    write_labels(file, [picture], (1920, 1080))
    file.write_text(json.dumps(_damaged(json.loads(file.read_text()), how)))
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
