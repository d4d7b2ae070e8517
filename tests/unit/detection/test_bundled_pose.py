"""Occluded people are found next to the person in front, and no person is found twice."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydantic import ValidationError

from worldpose.detection.bundled_pose import CropEstimates, assign_joints, find_occluded_people
from worldpose.detection.interfaces import People
from worldpose.detection.net_inference import run_together
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

    def __call__(self, _, asked):
        if not asked:
            return []
        ((boxes, others),) = asked
        self.asked.append(boxes)
        shares = box_iou(boxes, self.there)
        for row, known in zip(shares, others, strict=True):
            row[(box_iou(self.there, known) > 0.7).any(axis=1)] *= 1e-3
        seen = self.there[shares.argmax(axis=1)] if len(self.there) else np.full_like(boxes, np.nan)
        across = np.linspace(0.0, 1.0, 17)[:, None]
        joints = seen[:, None, :2] + (seen[:, 2:] - seen[:, :2])[:, None] * across
        places = np.repeat(joints[:, :, None], 4, axis=2) + np.arange(4.0)[:, None]
        flat = np.full((len(boxes), 17, 4), 0.8)
        return [CropEstimates(places, flat, flat, seen, np.full(len(boxes), self.fit))]


def found(*boxes, score=0.8):
    return People(np.array(boxes).reshape(-1, 4), np.full(len(boxes), score))


def test_who_is_hidden_by_half_is_found_once_with_his_own_box_and_pose():
    look = Told(FRONT, HIDDEN, FAR)
    (people,) = run_together([find_occluded_people(found(FRONT, FAR))], look)
    assert_allclose(people.boxes, [HIDDEN])
    assert_allclose(people.score, [np.cbrt(0.3 * 0.9 * 0.8)])
    assert_allclose(people.keypoints[0, 0], HIDDEN[:2])
    assert_allclose(people.keypoints[0, 16], HIDDEN[2:])
    # A step of 0.35 widths to either side of both; then about the one who was seen.
    assert_allclose(look.asked[0][:, 0], [86.0, 386.0, 114.0, 414.0])
    assert_allclose(look.asked[1], [HIDDEN] * len(look.asked[1]))


@pytest.mark.parametrize("people", [found(FRONT, FAR), found(FRONT, HIDDEN, FAR), found()])
def test_where_all_are_known_nobody_is_found(people):
    (others,) = run_together([find_occluded_people(people)], Told(*people.boxes))
    assert others.boxes.shape == (0, 4)
    assert others.score.shape == (0,)
    assert others.keypoints.shape == (0, 17, 2)
    assert others.confidence.shape == (0, 17)


@pytest.mark.parametrize("pose", ["onnx:net.onnx", "transformers:net"])
def test_another_pose_net_does_not_search_for_occluded_people(pose):
    with pytest.raises(ValidationError, match="find_occluded needs the bundled pose net"):
        DetectionSettings(find_occluded=True, pose=pose)
    assert DetectionSettings(find_occluded=True, pose="embedded:net.safetensors").find_occluded


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
