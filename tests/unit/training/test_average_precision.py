from pathlib import Path

import numpy as np
import pytest

from worldpose.detection.interfaces import People
from worldpose.training import LabelledPicture, average_precision


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


def test_nobody_found_is_zero():
    assert average_precision([found([], [])], [truth([NEAR])]) == 0.0


def test_a_false_box_between_two_right_ones():
    # Precision 1 at recall 1/2, 2/3 at recall 1: the area is 1/2 * 1 + 1/2 * 2/3.
    said = found([NEAR, AWAY, FAR], [0.9, 0.8, 0.7])
    assert average_precision([said], [truth([NEAR, FAR])]) == pytest.approx(5 / 6)


def test_precision_never_rises_with_recall():
    # Wrong, right, right: precision 1/2 and then 2/3, so that 2/3 holds at both recalls.
    said = found([AWAY, NEAR, FAR], [0.9, 0.8, 0.7])
    assert average_precision([said], [truth([NEAR, FAR])]) == pytest.approx(2 / 3)


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


def test_pictures_share_one_ranking():
    # The wrong box of the second picture is the surest of both.
    said = [found([NEAR], [0.5]), found([AWAY], [0.9])]
    assert average_precision(said, [truth([NEAR]), truth([])]) == pytest.approx(0.5)
