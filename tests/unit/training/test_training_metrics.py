from pathlib import Path

import numpy as np
import pytest

from worldpose.detection.interfaces import People
from worldpose.training.labels import LabelledPicture
from worldpose.training.metrics import (
    average_precision,
    correct_keypoints,
)


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
