"""Assignment of results: to the person, to no one, or to another person."""

import numpy as np
from bystander import NOISE, SIZE, as_stated, expected

from data_contracts.keypoints import KeypointDetections
from worldpose.filtering.redetection import (
    MissingPeople,
    RedetectionSettings,
    judge_search_results,
    search_missing_people,
)

SETTINGS = RedetectionSettings()
KINDS = ("found", "unsure", "elsewhere", "another")


def seek(bodies, *persons):
    """Look for these persons of the only frame."""
    return MissingPeople(
        np.zeros(len(persons), int), np.array(persons), bodies.boxes[0, persons], 0
    )


def answer(bodies, *persons, off=(0.0, 0.0), confidence=0.9):
    """Return detections of these bodies with an offset [px]."""
    keypoints = bodies.image[0, list(persons)] + off
    count = len(persons)
    return KeypointDetections(
        keypoints, np.full((count, 17), confidence), bodies.boxes[0, persons] + 0.0, np.ones(count)
    )


def judge(bodies, answers, sought, detected=()):
    pose = bodies.image[:, list(detected)] if len(detected) else np.empty((1, 0, 17, 2))
    boxes = bodies.boxes[:, list(detected)] if len(detected) else np.empty((1, 0, 4))
    none = np.full(pose.shape[:3], np.nan)
    given_ = KeypointDetections(pose, none, boxes, none[..., 0])
    return judge_search_results(answers, sought, bodies, given_, as_stated(), NOISE, SETTINGS)


def kinds(verdicts):
    return [next(k for k in KINDS if getattr(verdicts, k)[n]) for n in range(len(verdicts.found))]


def test_an_answer_where_the_body_is_is_the_person_s():
    bodies = expected((0.0, 0.0), (3.0, 0.0))
    verdicts = judge(bodies, answer(bodies, 0, off=(1.0, -1.0)), seek(bodies, 0), detected=[1])
    assert kinds(verdicts) == ["found"]
    assert not verdicts.rejected.any()


def test_the_neighbour_s_pose_is_the_neighbour_s():
    # A hand's breadth apart, and so unsure that either pose would do for both.
    bodies = expected((0.0, 0.0), (0.2, 0.0), deviation=0.14)
    assert kinds(judge(bodies, answer(bodies, 1), seek(bodies, 0))) == ["another"]


def test_of_two_who_are_given_one_pose_the_nearer_has_it():
    bodies = expected((0.0, 0.0), (0.08, 0.0), deviation=0.1)
    both = answer(bodies, 0, 0)
    assert kinds(judge(bodies, both, seek(bodies, 0, 1))) == ["found", "another"]


def test_a_wrist_that_is_not_the_body_s_is_left_out():
    bodies = expected((0.0, 0.0))
    seen = answer(bodies, 0)
    seen.keypoints[0, 9] += 25.0
    verdicts = judge(bodies, seen, seek(bodies, 0))
    assert kinds(verdicts) == ["found"]
    assert np.flatnonzero(verdicts.rejected[0]).tolist() == [9]


class Seeing:
    """Finds a person in the middle of each box, with low confidence in one arm."""

    def estimate(self, picture, boxes):
        middle = 0.5 * (boxes[:, None, :2] + boxes[:, None, 2:])
        confidence = np.full((len(boxes), 17), 0.8)
        confidence[:, 9] = 0.01
        return KeypointDetections.from_keypoints(np.repeat(middle, 17, axis=1), confidence)


class Asked(Seeing):
    """Records the requested boxes."""

    def estimate(self, picture, boxes):
        self.boxes = boxes.tolist()
        return super().estimate(picture, boxes)


def test_neighbours_who_overlap_are_shown_to_the_net_and_answered_for_by_nobody():
    bodies = expected((0.0, 0.0))
    sought = seek(bodies, 0)
    left, top, right, bottom = sought.boxes[0].tolist()
    beside = [right - 1.0, top, right + 30.0, bottom]
    touching = [left - 30.0, top, left, bottom]
    detected = np.array([[touching, beside, [np.nan] * 4]])
    net, picture = Asked(), np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    answers = search_missing_people([(0, picture)], sought, net, 0.05, detected)
    assert net.boxes == [[left, top, right, bottom], beside]
    np.testing.assert_allclose(answers.keypoints[0, 0, 0], 0.5 * (left + right), atol=1e-12)


def test_who_is_like_somebody_that_was_not_found_is_found_all_the_same():
    # Four pixels from one to the next: the similarity of poses is 0.8, and 0.5 over eight.
    bodies = expected((0.0, 0.0), (0.08, 0.0), (0.16, 0.0), deviation=0.1)
    off = np.array([0.0, 0.2, 0.4])[:, None, None] * [1.0, 0.0]
    verdicts = judge(bodies, answer(bodies, 0, 1, 2, off=off), seek(bodies, 0, 1, 2))
    assert kinds(verdicts) == ["found", "another", "found"]
