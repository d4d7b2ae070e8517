"""Held-out people: comparison of cameras, and cameras that contradict all others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import errors

from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.held_out_validation import held_out_errors
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints

QUICK = BundleAdjustmentSettings(max_frames=8, folds=2)
WRONG = 2


def placed_again(clip):
    """The clip with its people triangulated with the cameras that it has now."""
    detections = clip.detections
    placed = triangulate_joints(clip.cameras, detections, clip.triangulation)
    return replace(clip, joints=placed.joints, views=placed.views.astype(np.int64))


@pytest.fixture
def honest(clip):
    """A clip of eight cameras, the true ones, and the errors that adjustment leaves them."""
    made, true, _ = clip(cameras=8, seed=3)
    # Calibrations of one or two pixels, not of ten: three views or more agree about every joint.
    covariance = 0.02 * made.covariance
    spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    step = spread * np.random.default_rng(7).standard_normal((8, 12))
    made = placed_again(replace(made, cameras=step_camera(true, step), covariance=covariance))
    adjusted = adjust_cameras(made, QUICK)
    assert adjusted.accepted.all()
    return made, true, errors(adjusted.cameras, true)


def test_well_calibrated_cameras_stay_unless_the_change_is_beyond_chance(clip):
    made, true, _ = clip(cameras=8, seed=3)
    exact = placed_again(replace(made, cameras=true, covariance=1e-4 * made.covariance))
    adjusted = adjust_cameras(exact, QUICK)
    assert not adjusted.accepted.any()
    np.testing.assert_array_equal(adjusted.cameras.numbers, true.numbers)
    np.testing.assert_array_equal(adjusted.covariance, exact.covariance)
    # By chance the loss of some falls and that of others rises.
    falls = adjusted.verdict.loss[:, 1] < adjusted.verdict.loss[:, 0]
    assert falls.any()
    assert all("standard errors" in adjusted.reasons[c] for c in np.flatnonzero(falls))
    assert adjusted.evidence.shift > 0.0  # that of the proposed change


def test_a_camera_calibrated_wrong_is_mended_and_the_others_hardly_feel_it(honest):
    made, true, clean = honest
    step = np.zeros((8, 12))
    step[WRONG, 1] = 0.02  # 40 px, two hundred times what its calibration states
    adjusted = adjust_cameras(
        placed_again(replace(made, cameras=step_camera(made.cameras, step))), QUICK
    )
    assert adjusted.accepted.all()
    left = errors(adjusted.cameras, true)
    # It had a say in where the world is: without it the others lose an eighth of their knowledge.
    assert np.delete(left, WRONG).mean() < 1.25 * np.delete(clean, WRONG).mean()
    # A hundredth of what it was, and more than the others': people alone place it.
    assert left[WRONG] < 0.4


def test_true_cameras_are_judged_by_the_noise_alone(clip):
    made, true, _ = clip(cameras=6, noise=1.0)
    frames = np.arange(24)
    held = held_out_errors(made, true, frames, np.ones((24, 6), dtype=bool), robust_scale=100.0)
    # Two axes of unit variance, and what the joint of five other views adds: 2 (1 + 3 / (2 x 5)).
    assert np.nanmean(held.loss) == pytest.approx(2.6, rel=0.05)
