"""Noise that grows with camera, occlusion and missing views, learned where views disagree."""

import numpy as np
import pytest
from running_samples import MIRRORED, detections, runner

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.noise_model import (
    CONDITIONS,
    OCCLUDED,
    conditions,
    learn_noise,
    shared_variance,
)
from worldpose.triangulation.residuals import Rig, no_shift
from worldpose.triangulation.settings import TriangulationSettings


def test_a_worse_camera_is_learned_from_residuals(ring):
    cameras = ring(7)
    joints = runner(20, persons=12)
    keypoints, confidence, index = detections(cameras, joints, noise=2.0)
    exact, _, _ = detections(cameras, joints, noise=0.0)
    keypoints[:, 2] += 2.0 * (keypoints[:, 2] - exact[:, 2])
    seen = KeypointDetections.from_keypoints(keypoints, confidence, index)
    model = learn_noise(Rig.from_cameras(cameras), seen, no_shift(), (2.0, 0.0), 1e3)
    rest = np.delete(model.camera, 2, axis=0).mean()
    # Three times the noise; a prior of 20 degrees of freedom per frame holds the ratio back.
    assert 5.0 < model.camera[2].mean() / rest < 9.5
    precision = model.precision(confidence, conditions(keypoints))
    assert precision[:, 0].mean() > 5.0 * precision[:, 2].mean()


def test_views_that_miss_a_joint_raise_the_error_that_all_views_share():
    variance = shared_variance(np.array([0.02]), np.array([[[4], [3], [0]]]), np.array([[4, 4, 0]]))
    expected = 0.02 * (1.0 + OCCLUDED * np.array([0.0, 0.25, 1.0]))
    assert variance[0, :, 0] == pytest.approx(expected**2)


as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings(learn_noise=False, offsets="none")
FACE, ARMS, LEGS = range(len(EXCHANGED_PARTS))


def exchanged(array, joints=range(17)):
    out = array.copy()
    for joint in joints:
        out[..., joint, :] = array[..., MIRRORED[joint], :]
    return out


@pytest.fixture
def clip(ring):
    """Cameras, and keypoints, confidence and index of two runners seen without noise."""
    camera = ring(5)
    return camera, detections(camera, runner(12), 0.0)


def test_exchanged_sides_are_found_named_and_put_right(clip):
    camera, (keypoints, confidence, index) = clip
    expected = triangulate_joints(camera, as_detections(keypoints, confidence, index), SETTINGS)
    assert not expected.exchanged.any()
    wrong, truth = keypoints.copy(), np.zeros_like(expected.exchanged)
    wrong[3:7, 1, 0] = exchanged(keypoints[3:7, 1, 0])
    truth[3:7, 1, 0] = True
    legs = [joint for joint, name in enumerate(COCO17) if name[-4:] in ("_hip", "knee", "nkle")]
    wrong[5:9, 3, 1] = exchanged(keypoints[5:9, 3, 1], legs)
    truth[5:9, 3, 1, LEGS] = True
    found = triangulate_joints(camera, as_detections(wrong, confidence, index), SETTINGS)
    np.testing.assert_array_equal(found.exchanged, truth)
    # The same observations: the same joints to the last step of the iteration.
    np.testing.assert_allclose(found.joints, expected.joints, atol=1e-6)
    assert found.inliers.all()
    assert found.report.exchanged_share == (0.0, 4 / 24, 0.0, 4 / 24, 0.0)


def test_noise_is_not_taken_for_an_exchange(ring):
    # 6 px are twice the stated noise here; odds of fifty to one leave a few in a thousand.
    arrays = detections(ring(5), runner(40), 6.0)
    found = triangulate_joints(ring(5), as_detections(*arrays), SETTINGS)
    assert found.exchanged.any(axis=-1).mean() < 0.01


def standing(x: float, bottom: float, height: float) -> np.ndarray:
    """Keypoints (17, 2) [px] of an upright person whose trunk is a third of the height."""
    up = {"shoulder": 0.8, "hip": 0.8 - 1 / 3, "knee": 0.25, "ankle": 0.0, "elbow": 0.65}
    rows = [up.get(name.split("_")[-1], 0.9) for name in COCO17]
    side = [0.05 * (("left" in name) - ("right" in name)) for name in COCO17]
    return np.stack([x + height * np.array(side), bottom - height * np.array(rows)], axis=-1)


def test_keypoints_are_hidden_by_a_nearer_person_and_classed_by_their_distance_from_the_trunk():
    far, near = standing(300.0, 400.0, 120.0), standing(302.0, 450.0, 180.0)
    apart = standing(700.0, 400.0, 120.0)
    found = conditions(np.stack([far, near, apart])[None, None])[0, 0]
    alone = found[2]
    # The trunk's middle is at 0.633 of the height, its length a third: ankles are 1.9 away.
    assert alone[COCO17.index("left_ankle")] == 3
    assert alone[COCO17.index("left_knee")] == 2
    assert alone[COCO17.index("left_elbow")] == 0
    np.testing.assert_array_equal(found[1], alone)
    inside = (np.abs(far[:, 0] - 302.0) < 9.0) & (far[:, 1] > near[:, 1].min())
    np.testing.assert_array_equal(found[0], alone + CONDITIONS // 2 * inside)


def test_without_people_there_are_no_conditions():
    assert conditions(np.empty((4, 3, 0, 17, 2))).shape == (4, 3, 0, 17)
