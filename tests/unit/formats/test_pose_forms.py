"""People of MMPose's and Ultralytics' JSON are those of COCO results."""

import json

import numpy as np
import pytest
from test_keypoint_sets import BODY

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.formats.keypoint_files import read_people

PLACES = np.array([BODY[name] for name in COCO17]) + (500.25, 300.5)
SURE = np.linspace(0.3, 1.2, 17).round(2)


def mmpose():
    return {
        "keypoints": PLACES.tolist(),
        "keypoint_scores": SURE.tolist(),
        "bbox": [[90, 80, 950, 940]],
        "bbox_score": 0.8,
    }


def ultralytics(scale=1.0):
    x, y = (scale * PLACES).T.tolist()
    return {
        "name": "person",
        "class": 0,
        "confidence": 0.8,
        "box": {"x1": 90, "y1": 80, "x2": 950, "y2": 940},
        "keypoints": {"x": x, "y": y, "visible": SURE.tolist()},
    }


def demo(first=1):
    frames = [{"frame_id": first + n, "instances": [mmpose()] * (n != 1)} for n in range(3)]
    names = {str(n): name for n, name in enumerate(COCO17)}
    return {"meta_info": {"keypoint_id2name": names}, "instance_info": frames}


@pytest.mark.parametrize(
    "content",
    [
        demo(),
        demo(0),
        demo(0)["instance_info"],
        [[ultralytics()], [], [ultralytics()]],
        [json.dumps([ultralytics()]), "[]", json.dumps([ultralytics()])],
    ],
)
def test_a_file_of_all_frames(tmp_path, content):
    (tmp_path / "cam.json").write_text(json.dumps(content))
    found = read_people(tmp_path / "cam.json")
    assert found.people.frame.tolist() == [0, 2]
    np.testing.assert_allclose(found.people.keypoints[1, 0], PLACES, rtol=1e-6)
    np.testing.assert_allclose(found.people.confidence[1, 0], np.minimum(SURE, 1.0), rtol=1e-6)
    np.testing.assert_allclose(found.people.boxes[1, 0], [90, 80, 950, 940])
    assert found.changes.clamped == 2 * (SURE > 1.0).sum()


def test_keypoints_without_scores_are_sure(tmp_path):
    person = ultralytics()
    person["keypoints"]["visible"] = None
    (tmp_path / "cam.json").write_text(json.dumps([[person]]))
    assert (read_people(tmp_path / "cam.json").people.confidence == 1.0).all()


@pytest.mark.parametrize("person", [mmpose(), ultralytics()])
def test_a_file_of_each_frame(tmp_path, person):
    info = {"meta_info": {}, "instance_info": [person]}
    for number, people in ((7, info), (8, []), (9, [person, person])):
        (tmp_path / f"cam_{number:06d}.json").write_text(json.dumps(people))
    people = read_people(tmp_path).people
    assert people.frame.tolist() == [7, 8, 9]
    np.testing.assert_allclose(people.keypoints[2, 1], PLACES, rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([ultralytics()], "people of one image"),
        ([[ultralytics(1e-3)]], "shares of the image"),
        ([[{"name": "person", "box": {}}]], "of poses, not of boxes"),
        (demo(5), "begin with 0 or 1"),
        ([[{**ultralytics(), "keypoints": {"x": [1], "y": [1, 2]}}]], "lists of 1 and 2"),
        ([[{**mmpose(), "keypoint_scores": [1.0]}]], "lists of 17 and 17 and 1"),
        ([[{**mmpose(), "keypoints": [[1, 2, 3]] * 17}]], "result 0, keypoints"),
    ],
)
def test_what_does_not_say_its_frame_or_pixels_is_refused(tmp_path, content, words):
    (tmp_path / "cam.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        read_people(tmp_path / "cam.json")
    assert words in str(caught.value)
