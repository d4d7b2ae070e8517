"""Whom others hide is found beside them, and nobody is found twice."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_contracts.keypoints import KeypointDetections
from worldpose.detection import DetectionSettings, People, PeopleFinder, Place
from worldpose.detection.boxes import overlaps
from worldpose.detection.bundled import embedded_pose
from worldpose.detection.bundled_looks import Look
from worldpose.detection.flip_test import Mirrored
from worldpose.detection.interfaces import LooksBeside
from worldpose.detection.occluded_people import find_occluded_people

FRONT = np.array([100.0, 50.0, 140.0, 150.0])
HIDDEN = FRONT + [18.0, -6.0, 18.0, -6.0]
FAR = FRONT + [300.0, 0.0, 300.0, 0.0]


class Told:
    """Sees of those who are there the one nearest to what is asked for, but nobody it was told of.

    Where it was told of everybody it sees whom it was told of.
    """

    def __init__(self, *there, fit=0.9):
        self.there, self.fit, self.asked = np.array(there).reshape(-1, 4), fit, []

    def __call__(self, boxes, others):
        self.asked.append(boxes)
        shares = overlaps(boxes, self.there)
        for row, known in zip(shares, others, strict=True):
            row[(overlaps(self.there, known) > 0.7).any(axis=1)] *= 1e-3
        seen = self.there[shares.argmax(axis=1)] if len(self.there) else np.full_like(boxes, np.nan)
        across = np.linspace(0.0, 1.0, 17)[:, None]
        joints = seen[:, None, :2] + (seen[:, 2:] - seen[:, :2])[:, None] * across
        places = np.repeat(joints[:, :, None], 4, axis=2) + np.arange(4.0)[:, None]
        flat = np.full((len(boxes), 17, 4), 0.8)
        return Look(places, flat, flat, seen, np.full(len(boxes), self.fit))


def found(*boxes, score=0.8):
    return People(np.array(boxes).reshape(-1, 4), np.full(len(boxes), score))


def test_who_is_hidden_by_half_is_found_once_with_his_own_box_and_pose():
    look = Told(FRONT, HIDDEN, FAR)
    people = find_occluded_people(look, found(FRONT, FAR))
    assert_allclose(people.boxes, [HIDDEN])
    assert_allclose(people.score, [np.cbrt(0.3 * 0.9 * 0.8)])
    assert_allclose(people.keypoints[0, 0], HIDDEN[:2])
    assert_allclose(people.keypoints[0, 16], HIDDEN[2:])
    # A step of 0.35 widths to either side of both; then about the one who was seen.
    assert_allclose(look.asked[0][:, 0], [86.0, 386.0, 114.0, 414.0])
    assert_allclose(look.asked[1], [HIDDEN] * len(look.asked[1]))


@pytest.mark.parametrize("people", [found(FRONT, FAR), found(FRONT, HIDDEN, FAR), found()])
def test_where_all_are_known_nobody_is_found(people):
    others = find_occluded_people(Told(*people.boxes), people)
    assert others.boxes.shape == (0, 4)
    assert others.score.shape == (0,)
    assert others.keypoints.shape == (0, 17, 2)
    assert others.confidence.shape == (0, 17)


def test_nobody_is_asked_for_where_somebody_is_known():
    beside = FRONT + [14.0, 0.0, 14.0, 0.0]
    look = Told(FRONT, beside)
    find_occluded_people(look, found(FRONT, beside))
    # Left of the first and right of the second.
    assert_allclose(look.asked[0][:, 0], [86.0, 128.0])


def test_beside_whom_the_detector_doubts_nobody_is_asked_for():
    look = Told(FRONT, HIDDEN)
    people = find_occluded_people(look, found(FRONT, score=0.2))
    assert len(people.boxes) == 0
    assert len(look.asked[0]) == 0


def test_an_answer_that_is_not_sure_is_none():
    assert len(find_occluded_people(Told(FRONT, HIDDEN, fit=0.51), found(FRONT)).boxes) == 1
    assert len(find_occluded_people(Told(FRONT, HIDDEN, fit=0.49), found(FRONT)).boxes) == 0


class Finding:
    """Finds the one in front; asked about him, it finds whom he hides."""

    view_size = None

    def detect(self, pictures):
        return [found(FRONT)] * len(pictures)

    def estimate(self, picture, boxes):
        return KeypointDetections.from_keypoints(
            np.repeat(boxes[:, None, :2], 17, axis=1), np.full((len(boxes), 17), 0.9)
        )

    def beside(self, picture, people):
        return KeypointDetections(
            np.full((1, 17, 2), 200.0), np.full((1, 17), 0.9), HIDDEN[None], np.array([0.5])
        )


def people_of(settings, place=None):
    finding = Finding()
    finder = PeopleFinder([finding], finding, settings)
    (stretch,) = finder.find(((n, np.zeros((240, 320, 3), np.uint8)) for n in range(2)), place)
    return np.isfinite(stretch.score[0]).sum(), finder.report.beside


def test_they_are_kept_as_people_of_the_picture():
    assert people_of(DetectionSettings(find_occluded=True)) == (2, 2)
    assert people_of(DetectionSettings()) == (1, 0)


def test_a_bystander_whom_a_player_hides_is_crowd(monkeypatch):
    monkeypatch.setattr(
        "worldpose.detection.people.on_pitch", lambda boxes, *_: boxes[:, 0] <= FRONT[0]
    )
    assert people_of(DetectionSettings(find_occluded=True), Place(None, None)) == (1, 2)


def test_the_embedded_net_looks_beside_and_means_of_two_looks_do_not():
    pose = embedded_pose()
    assert isinstance(pose, LooksBeside)
    assert not isinstance(Mirrored(pose), LooksBeside)
    people = pose.beside(np.zeros((240, 320, 3), np.uint8), found(FRONT))
    assert len(people.boxes) == len(people.keypoints) == 0  # nobody in the dark
