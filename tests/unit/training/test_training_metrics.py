from pathlib import Path

import numpy as np
import pytest

from worldpose.detection.interfaces import People
from worldpose.training.labels import LabelledPicture
from worldpose.training.metrics import (
    average_precision,
    calibration_error,
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


def test_nobody_to_find_has_no_precision():
    assert np.isnan(average_precision([found([NEAR], [0.9])], [truth([])]))


def test_a_false_box_between_two_right_ones():
    # Precision 1 at recall 1/2, 2/3 at recall 1: the area is 1/2 * 1 + 1/2 * 2/3.
    said = found([NEAR, AWAY, FAR], [0.9, 0.8, 0.7])
    assert average_precision([said], [truth([NEAR, FAR])]) == pytest.approx(5 / 6)


def test_the_second_box_on_a_person_is_false():
    # Right, wrong, right as above, though the second box would be right alone.
    said = found([NEAR, NEAR, FAR], [0.9, 0.8, 0.7])
    assert average_precision([said], [truth([NEAR, FAR])]) == pytest.approx(5 / 6)


def test_an_overlap_of_half_is_the_least():
    # 20 x 40 boxes shifted along x by s overlap by (20 - s) / (20 + s): 0.5 at 20 / 3.
    just, off = [6.6, 0, 26.6, 40], [6.7, 0, 26.7, 40]
    assert average_precision([found([just], [0.5])], [truth([NEAR])]) == 1.0
    assert average_precision([found([off], [0.5])], [truth([NEAR])]) == 0.0


def test_ignored_people_are_neither_asked_for_nor_false():
    said = found([AWAY, NEAR], [0.9, 0.8])
    assert average_precision([said], [truth([NEAR, AWAY], [False, True])]) == 1.0


def test_people_of_other_heights_do_not_count():
    small, strange = [200, 0, 210, 20], [400, 0, 410, 20]
    said = found([small, strange, NEAR], [0.9, 0.8, 0.7])
    assert average_precision([said], [truth([NEAR, small])], (30.0, 50.0)) == 1.0
    # Of all heights: right, wrong, right.
    assert average_precision([said], [truth([NEAR, small])]) == pytest.approx(5 / 6)


LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_HIP, RIGHT_HIP, NOSE = 5, 6, 11, 12, 0


@pytest.fixture
def person():
    """Shoulders 40 px apart, 30 px above both hips, which are on one point between them."""
    keypoints = np.zeros((1, 17, 2))
    keypoints[0, LEFT_SHOULDER], keypoints[0, RIGHT_SHOULDER] = (40.0, 0.0), (0.0, 0.0)
    keypoints[0, LEFT_HIP] = keypoints[0, RIGHT_HIP] = (0.0, 30.0)
    return keypoints


def test_a_keypoint_within_a_fifth_of_the_torso_is_correct(person):
    found = person.copy()
    found[0, NOSE, 0] = 10.0
    found[0, LEFT_HIP, 1] += 10.01
    correct = correct_keypoints(found, person)
    assert correct[0, NOSE] == 1.0 and correct[0, LEFT_HIP] == 0.0
    assert correct.sum() == 16.0


def test_a_missing_keypoint_is_not_correct_and_an_unknown_one_does_not_count(person):
    found, true = person.copy(), person.copy()
    found[0, 9], true[0, 10] = np.nan, np.nan
    correct = correct_keypoints(found, true)
    assert correct[0, 9] == 0.0 and np.isnan(correct[0, 10])


def test_confidence_that_says_the_share_of_right_ones_is_calibrated():
    confidence = np.array([0.25] * 4 + [0.75] * 4)
    right = np.array([True, False, False, False, True, True, True, False])
    assert calibration_error(confidence, right, classes=2) == pytest.approx(0.0)
    # All right: 0.75 and 0.25 too modest, each for half of them.
    assert calibration_error(confidence, np.ones(8, dtype=bool), classes=2) == pytest.approx(0.5)
