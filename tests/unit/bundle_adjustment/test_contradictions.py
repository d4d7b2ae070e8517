"""A camera that contradicts all others does not drag them."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.bundle_adjustment import BundleAdjustmentSettings, adjust_cameras
from worldpose.static_calibration import stepped
from worldpose.triangulation import triangulate_joints

QUICK = BundleAdjustmentSettings(frames=8, folds=2)
WRONG = 2


def errors(cameras, true):
    """Mean distance [px] by which cameras put people's places beside the true ones."""
    places = np.array([[x, y, 1.0] for x in (-8.0, 0.0, 8.0) for y in (-8.0, 0.0, 8.0)])
    return np.linalg.norm(cameras.project(places) - true.project(places), axis=-1).mean(axis=-1)


def placed_again(clip):
    """The clip with its people triangulated with the cameras that it has now."""
    index = clip.detection_index.astype(np.int16)
    placed = triangulate_joints(
        clip.cameras, clip.keypoints, clip.confidence, index, clip.triangulation
    )
    return replace(clip, joints=placed.joints, views=placed.views.astype(np.int64))


@pytest.fixture
def honest(clip):
    """A clip of eight cameras, the true ones, and the errors that adjustment leaves them."""
    made, true, _ = clip(cameras=8, seed=3)
    # Calibrations of a pixel, not of ten: three views or more agree about every joint.
    covariance = 0.01 * made.covariance
    spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    step = spread * np.random.default_rng(7).standard_normal((8, 12))
    made = placed_again(replace(made, cameras=stepped(true, step), covariance=covariance))
    adjusted = adjust_cameras(made, QUICK)
    assert adjusted.accepted.all()
    return made, true, errors(adjusted.cameras, true)


def test_a_camera_calibrated_wrong_is_mended_and_the_others_hardly_feel_it(honest):
    made, true, clean = honest
    step = np.zeros((8, 12))
    step[WRONG, 1] = 0.02  # 40 px, two hundred times what its calibration states
    adjusted = adjust_cameras(
        placed_again(replace(made, cameras=stepped(made.cameras, step))), QUICK
    )
    assert adjusted.accepted.all()
    left = errors(adjusted.cameras, true)
    # It had a say in where the world is: without it the others lose an eighth of their knowledge.
    assert np.delete(left, WRONG).mean() < 1.25 * np.delete(clean, WRONG).mean()
    # A hundredth of what it was, and more than the others': people alone place it.
    assert left[WRONG] < 0.4


def test_a_camera_that_shows_other_people_has_no_say(honest):
    made, true, clean = honest
    index = made.detection_index.copy()
    index[:, WRONG] = np.roll(index[:, WRONG], 1, axis=-1)
    adjusted = adjust_cameras(placed_again(replace(made, detection_index=index)), QUICK)
    assert np.flatnonzero(~adjusted.accepted).tolist() == [WRONG]
    assert "shows other people" in adjusted.reasons[WRONG]
    np.testing.assert_array_equal(adjusted.cameras.numbers[WRONG], made.cameras.numbers[WRONG])
    np.testing.assert_array_equal(adjusted.covariance[WRONG], made.covariance[WRONG])
    left = errors(adjusted.cameras, true)
    assert np.delete(left, WRONG).mean() < 1.25 * np.delete(clean, WRONG).mean()
