"""Occluded people are found next to the person in front, and no person is found twice."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from pydantic import ValidationError

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.bundled_nets import decode_candidates
from worldpose.detection.bundled_pose import (
    CropEstimates,
    assign_joints,
    find_occluded_people,
    surroundings,
)
from worldpose.detection.interfaces import People
from worldpose.detection.pipeline import PeopleFinder, Place
from worldpose.detection.settings import DetectionSettings
from worldpose.geometry.boxes import box_iou

FRONT = np.array([100.0, 50.0, 140.0, 150.0])
HIDDEN = FRONT + [18.0, -6.0, 18.0, -6.0]
FAR = FRONT + [300.0, 0.0, 300.0, 0.0]


class Told:
    """Finds the present person nearest to the box, except those given as neighbours.

    If all are given as neighbours, it finds one of them.
    """

    def __init__(self, *there, fit=0.9):
        self.there, self.fit, self.asked = np.array(there).reshape(-1, 4), fit, []

    def __call__(self, boxes, others):
        self.asked.append(boxes)
        shares = box_iou(boxes, self.there)
        for row, known in zip(shares, others, strict=True):
            row[(box_iou(self.there, known) > 0.7).any(axis=1)] *= 1e-3
        seen = self.there[shares.argmax(axis=1)] if len(self.there) else np.full_like(boxes, np.nan)
        across = np.linspace(0.0, 1.0, 17)[:, None]
        joints = seen[:, None, :2] + (seen[:, 2:] - seen[:, :2])[:, None] * across
        places = np.repeat(joints[:, :, None], 4, axis=2) + np.arange(4.0)[:, None]
        flat = np.full((len(boxes), 17, 4), 0.8)
        return CropEstimates(places, flat, flat, seen, np.full(len(boxes), self.fit))


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


def test_an_answer_that_is_not_sure_is_none():
    assert len(find_occluded_people(Told(FRONT, HIDDEN, fit=0.51), found(FRONT)).boxes) == 1
    assert len(find_occluded_people(Told(FRONT, HIDDEN, fit=0.49), found(FRONT)).boxes) == 0


class Finding:
    """Finds the person in front; with that one as neighbour, it finds the occluded one."""

    view_size = None

    def detect(self, pictures):
        return [found(FRONT)] * len(pictures)

    def estimate(self, picture, boxes):
        return KeypointDetections.from_keypoints(
            np.repeat(boxes[:, None, :2], 17, axis=1), np.full((len(boxes), 17), 0.9)
        )

    def find_occluded(self, picture, people):
        return KeypointDetections(
            np.full((1, 17, 2), 200.0), np.full((1, 17), 0.9), HIDDEN[None], np.array([0.5])
        )


def people_of(settings, place=None):
    finding = Finding()
    finder = PeopleFinder([finding], finding, settings)
    (stretch,) = finder.find(((n, np.zeros((240, 320, 3), np.uint8)) for n in range(2)), place)
    return np.isfinite(stretch.score[0]).sum(), finder.report.beside


def test_a_bystander_whom_a_player_hides_is_crowd(monkeypatch):
    monkeypatch.setattr(
        "worldpose.detection.pipeline.on_pitch", lambda boxes, *_: boxes[:, 0] <= FRONT[0]
    )
    assert people_of(DetectionSettings(find_occluded=True), Place(None, None)) == (1, 2)


def test_settings_refuse_the_search_for_occluded_people_in_a_flip_test():
    with pytest.raises(ValidationError, match=r"find_occluded and .*flip_test exclude each other"):
        DetectionSettings(find_occluded=True, flip_test=True)


@pytest.mark.parametrize("pose", ["onnx:net.onnx", "transformers:net"])
def test_another_pose_net_does_not_search_for_occluded_people(pose):
    with pytest.raises(ValidationError, match="find_occluded needs the bundled pose net"):
        DetectionSettings(find_occluded=True, pose=pose)
    assert DetectionSettings(find_occluded=True, pose="embedded:net.safetensors").find_occluded


AS_IS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_cells_are_as_full_as_boxes_cover_them():
    # A crop of 8 x 12 px: cells of 4 px with their edges at -0.5, 3.5, 7.5 and 11.5.
    box = np.array([-0.5, -0.5, 3.5, 9.5])
    others = np.array([[3.5, -0.5, 5.5, 11.5], [-0.5, 3.5, 7.5, 7.5], [-0.5, -0.5, 3.5, 3.5]])
    mine, before, behind = surroundings(box, others, AS_IS, (8, 12))
    np.testing.assert_allclose(mine, [[1, 0], [1, 0], [0.5, 0]])
    # Only the first one's feet are lower than the one's asked for; two behind make no more of one.
    np.testing.assert_allclose(before, [[0, 0.5], [0, 0.5], [0, 0.5]])
    np.testing.assert_allclose(behind, [[1, 0], [1, 1], [0, 0]])
    alone = surroundings(box, np.empty((0, 4)), AS_IS, (8, 12))
    np.testing.assert_array_equal(alone[0], mine)
    assert not alone[1:].any()


def test_places_come_with_their_probability_and_the_likeliest_first():
    maps = torch.full((1, 1, 32, 24), -40.0)
    # A sharp peak of a quarter, and one of three quarters spread over two cells of a row as 2 : 1.
    maps[0, 0, 5, 5], maps[0, 0, 20, 10], maps[0, 0, 20, 11] = 0.0, float(np.log(2.0)), 0.0
    places, mass = decode_candidates(maps, 3)
    # Cells of 2 px whose first middle is at 0.5.
    torch.testing.assert_close(places[0, 0, :2], torch.tensor([[21.5 - 1 / 3, 40.5], [10.5, 10.5]]))
    # Of whatever is as likely, nothing is left but the rounding of e^-40.
    torch.testing.assert_close(mass[0, 0], torch.tensor([0.75, 0.25, 0.0]), atol=1e-6, rtol=0)


def rivals(first, second, boxes=((0, 0, 40, 100), (20, 0, 60, 100))):
    """Where two people have their noses, of x 10, 30 and 50 with these chances."""
    places = np.zeros((2, 17, 3, 2))
    places[..., 0] = [10.0, 30.0, 50.0]
    mass = np.tile(np.array([first, second])[:, None], (1, 17, 1))
    # The likeliest come first.
    order = np.argsort(-mass, axis=-1, kind="stable")
    places = np.take_along_axis(places, order[..., None], axis=2)
    mass = np.take_along_axis(mass, order, axis=2)
    taken = assign_joints(places, mass, np.array(boxes, dtype=np.float64))
    return np.take_along_axis(places, taken[..., None, None], axis=2)[:, 0, 0, 0].tolist()


def test_who_is_less_sure_leaves_a_place_to_his_neighbour():
    assert rivals([0.1, 0.9, 0.0], [0.0, 0.5, 0.4]) == [30.0, 50.0]
    # He does not take one that is next to impossible.
    assert rivals([0.1, 0.9, 0.0], [0.0, 0.98, 0.015]) == [30.0, 30.0]


def test_a_joint_is_not_put_where_a_neighbour_has_that_of_the_other_side():
    places, mass = np.zeros((2, 17, 2, 2)), np.zeros((2, 17, 2))
    # Joints of their own, far from all others, but for one's left ankle and the other's right.
    places[..., 0, 1] = np.arange(34).reshape(2, 17) * 100.0
    mass[..., 0] = 1.0
    left, right = 15, 16
    places[0, left, 0] = places[1, right, 0] = [5.0, -100.0]
    places[1, right, 1], mass[1, right] = [20.0, -100.0], [0.5, 0.4]
    taken = assign_joints(
        places, mass, np.array([[0.0, 0.0, 40.0, 100.0], [20.0, 0.0, 60.0, 100.0]])
    )
    assert np.argwhere(taken).tolist() == [[1, right]]
