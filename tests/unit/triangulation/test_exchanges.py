import numpy as np
import pytest
from running_samples import FPS, MIRRORED, detections, runner

from data_contracts.conventions import COCO17
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.triangulation import (
    TriangulationSettings,
    put_right,
    reconstruct_joints,
    triangulate_joints,
)

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


def test_parts_have_every_joint_with_a_side_once():
    names = [name for part in EXCHANGED_PARTS.values() for name in part]
    sided = {name.removeprefix("left_") for name in COCO17 if name.startswith("left_")}
    assert sorted(names) == sorted(sided)


def test_exchanged_sides_are_found_named_and_put_right(clip):
    camera, (keypoints, confidence, index) = clip
    expected = triangulate_joints(camera, keypoints, confidence, index, SETTINGS)
    assert not expected.exchanged.any()
    wrong, truth = keypoints.copy(), np.zeros_like(expected.exchanged)
    wrong[3:7, 1, 0] = exchanged(keypoints[3:7, 1, 0])
    truth[3:7, 1, 0] = True
    legs = [joint for joint, name in enumerate(COCO17) if name[-4:] in ("_hip", "knee", "nkle")]
    wrong[5:9, 3, 1] = exchanged(keypoints[5:9, 3, 1], legs)
    truth[5:9, 3, 1, LEGS] = True
    found = triangulate_joints(camera, wrong, confidence, index, SETTINGS)
    np.testing.assert_array_equal(found.exchanged, truth)
    # The same observations: the same joints to the last step of the iteration.
    np.testing.assert_allclose(found.joints, expected.joints, atol=1e-6)
    assert found.inliers.all()
    assert found.report.exchanged_share == (0.0, 4 / 24, 0.0, 4 / 24, 0.0)


def test_exchanges_that_are_not_to_be_undone_are_rejected_views(clip):
    camera, (keypoints, confidence, index) = clip
    keypoints[:, 1] = exchanged(keypoints[:, 1])
    left = SETTINGS.model_copy(update={"undo_exchanges": False})
    found = triangulate_joints(camera, keypoints, confidence, index, left)
    assert not found.exchanged.any()
    assert found.report.rejected_share[1] > 0.5


def test_noise_is_not_taken_for_an_exchange(ring):
    # 6 px are twice the stated noise here; odds of fifty to one leave a few in a thousand.
    arrays = detections(ring(5), runner(40), 6.0)
    found = triangulate_joints(ring(5), *arrays, SETTINGS)
    assert found.exchanged.any(axis=-1).mean() < 0.01


def test_smoothing_sees_the_sides_put_right(clip):
    camera, (keypoints, confidence, index) = clip
    expected = reconstruct_joints(camera, keypoints, confidence, index, FPS, SETTINGS)
    wrong = keypoints.copy()
    wrong[3:7, 1, 0] = exchanged(keypoints[3:7, 1, 0])
    found = reconstruct_joints(camera, wrong, confidence, index, FPS, SETTINGS)
    # The iteration ends at steps of 0.1 mm.
    np.testing.assert_allclose(found.smoothing.joints, expected.smoothing.joints, atol=2e-4)


def test_what_was_seen_is_put_right_as_triangulation_did(clip):
    camera, (keypoints, confidence, index) = clip
    wrong = keypoints.copy()
    wrong[3:7, 1, 0] = exchanged(keypoints[3:7, 1, 0])
    found = triangulate_joints(camera, wrong, confidence, index, SETTINGS)
    np.testing.assert_array_equal(put_right(wrong, index, found.exchanged), keypoints)
    nothing = np.zeros_like(found.exchanged)
    np.testing.assert_array_equal(put_right(wrong, index, nothing), wrong)
