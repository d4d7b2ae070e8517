import json
from pathlib import Path

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.training import LabelledPicture, read_labels, write_labels


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
