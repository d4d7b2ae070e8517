"""Corrections of detections change what they name and nothing else, or say why not."""

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from data_contracts.review import AddedDetection, DeletedDetection, MovedKeypoint
from worldpose.review.detections import replay_detections

FIRST = 50
"""Match frame of the first row."""


def observations():
    """Two frames, two people; the second is not there in the second frame."""
    keypoints = np.arange(2 * 2 * 17 * 2, dtype=np.float32).reshape(2, 2, 17, 2)
    confidence = np.full((2, 2, 17), 0.5, dtype=np.float32)
    boxes = np.ones((2, 2, 4), dtype=np.float32)
    score = np.full((2, 2), 0.9, dtype=np.float32)
    for array in (keypoints, confidence, boxes, score):
        array[1, 1] = np.nan
    return KeypointDetections(keypoints, confidence, boxes, score, np.arange(FIRST, FIRST + 2))


def keypoint(xy, was=(0.0, 1.0), **where):
    place = {"camera": "a", "frame": FIRST, "detection": 0, "joint": "nose"} | where
    return MovedKeypoint(**place, was=was, xy=xy)


def deleted(frame=FIRST, detection=0, was=None):
    return DeletedDetection(camera="a", frame=frame, detection=detection, was=was)


def added(detection, frame=FIRST + 1, nose=(3.0, 4.0)):
    keypoints = (nose,) + (None,) * 16
    box = (1.0, 2.0, 5.0, 9.0)
    return AddedDetection(
        camera="a", frame=frame, detection=detection, box=box, keypoints=keypoints
    )


def changed(edit):
    """Return the changes of an edit, as (name, index) of every value."""
    found, before = observations(), observations()
    replay = replay_detections(found, [edit])
    assert replay.objections == (None,)
    assert all(map(same, found.arrays().values(), before.arrays().values()))  # the input stays
    after = replay.observations.arrays()
    return {
        name: np.argwhere(~((array == after[name]) | (np.isnan(array) & np.isnan(after[name]))))
        for name, array in before.arrays().items()
    }


def same(one, other):
    return np.array_equal(one, other, equal_nan=True)


def test_a_keypoint_taken_out_is_not_seen_any_more():
    places = changed(keypoint(None))
    assert places["keypoints"].tolist() == [[0, 0, 0, 0], [0, 0, 0, 1]]
    assert places["confidence"].tolist() == [[0, 0, 0]]
    assert len(places["boxes"]) == len(places["score"]) == 0


def test_a_keypoint_put_elsewhere_is_certain():
    replay = replay_detections(observations(), [keypoint((7.5, 8.5))])
    assert replay.observations.keypoints[0, 0, 0].tolist() == [7.5, 8.5]
    assert replay.observations.confidence[0, 0, 0] == 1.0
    again = keypoint((0.0, 1.0), was=(7.5, 8.5))
    there_and_back = replay_detections(observations(), [keypoint((7.5, 8.5)), again])
    assert there_and_back.objections == (None, None)
    assert same(there_and_back.observations.keypoints, observations().keypoints)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (keypoint(None, frame=FIRST - 1), f"no frame {FIRST - 1}"),
        (keypoint(None, frame=FIRST + 1, detection=1), "no detection 1"),
        (keypoint(None, was=(0.0, 1.5)), "was (0.0, 1.5) when it was corrected, and is [0.0, 1.0]"),
        (keypoint((1.0, 1.0), was=None), "was not seen when"),
        (deleted(frame=FIRST + 1, detection=1), "no detection 1"),
        (deleted(was=(1.0, 1.0, 1.0, 2.0)), "was [1.0, 1.0, 1.0, 2.0] when it was deleted"),
        (added(0), "there is a detection 0"),
        (added(3), "2 is the next"),
    ],
)
def test_what_does_not_fit_what_was_seen_says_why_and_changes_nothing(edit, reason):
    replay = replay_detections(observations(), [edit])
    (objection,) = replay.objections
    assert reason in objection
    for name, array in replay.observations.arrays().items():
        assert same(array, observations().arrays()[name])


def test_an_added_person_takes_a_free_place_and_is_certain():
    places = changed(added(1))
    assert places["keypoints"].tolist() == [[1, 1, 0, 0], [1, 1, 0, 1]]
    assert places["confidence"].tolist() == [[1, 1, 0]]
    assert places["boxes"].tolist() == [[1, 1, k] for k in range(4)]
    after = replay_detections(observations(), [added(1)]).observations
    assert (after.score[1, 1], after.confidence[1, 1, 0]) == (1.0, 1.0)
    assert after.boxes[1, 1].tolist() == [1.0, 2.0, 5.0, 9.0]
