"""Given cameras, no pitch: adjustment improves or refuses, and never drifts."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.bundle_adjustment.clip import Clicks
from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints

CASES = {
    "exact": ([0.0] * 3, [0.0] * 3, 1.0),
    "small": ([1e-4] * 3, [0.005] * 3, 1.0),
    "large": ([5e-3] * 3, [0.3] * 3, 1.0),
    "focal": ([0.0] * 3, [0.0] * 3, 1.1),
}
"""Errors about and along the axes [rad, m], and a factor of the focal length of camera 1."""


def given(clip, cameras, **changes):
    """The clip without clicks, with exact covariances of these cameras."""
    seen = changes.get("detections", clip.detections)
    placed = triangulate_joints(cameras, seen, clip.triangulation)
    return replace(
        clip,
        cameras=cameras,
        covariance=np.zeros_like(clip.covariance),
        clicks=(Clicks.none(),) * len(cameras.focal),
        joints=placed.joints,
        views=placed.views.astype(np.int64),
        **changes,
    )


@pytest.mark.parametrize("case", CASES)
def test_joints_are_never_worse_than_with_the_given_cameras(clip, case):
    made, true, joints = clip(cameras=4, frames=40, lasting=1.0, seed=3)
    turn, shift, focal = CASES[case]
    rng = np.random.default_rng(5)
    step = np.zeros((4, 12))
    step[:, :6] = np.array([*turn, *shift]) * rng.standard_normal((4, 6))
    step[1, 6] = np.log(focal)
    made = given(made, step_camera(true, step))
    adjusted = adjust_cameras(made)
    told = adjusted.covariance if adjusted.accepted.all() else None
    after = triangulate_joints(adjusted.cameras, made.detections, made.triangulation, told).joints
    before, after = (
        np.nanmean(np.linalg.norm(each - joints, axis=-1)) for each in (made.joints, after)
    )
    assert after < before + 0.001
    if case in ("exact", "small"):
        assert not adjusted.accepted.any()
        np.testing.assert_array_equal(adjusted.motion, 0.0)
        assert all(reason.startswith("refused") for reason in adjusted.reasons)
    else:
        assert after < 0.9 * before


def test_refused_given_cameras_do_not_pull_the_others(clip):
    made, true, _ = clip(cameras=8, frames=60, lasting=1.0, seed=1)
    # Two cameras err by 5 cm together, and have too few keypoints for a change.
    step = np.zeros((8, 12))
    scale = np.array([1e-3] * 3 + [0.1] * 3)
    step[:, :6] = scale * np.random.default_rng(2).standard_normal((8, 6))
    step[:2, 3:6] = true.cam_from_world.rotation[:2] @ [0.3, 0.0, 0.0]
    cameras = step_camera(true, step)
    confidence = made.detections.confidence.copy()
    confidence[:, :2, :, ::2] = 0.0
    seen = replace(made.detections, confidence=confidence)
    made = given(made, cameras, detections=seen)
    adjusted = adjust_cameras(made, BundleAdjustmentSettings(min_judges=1200))
    np.testing.assert_array_equal(adjusted.accepted, [False] * 2 + [True] * 6)
    np.testing.assert_array_equal(adjusted.cameras.numbers[:2], cameras.numbers[:2])
    others = seen.detection_index.copy()
    others[:, :2] = -1
    before, after = (
        triangulate_joints(each, seen.assign_people(others), made.triangulation).joints
        for each in (cameras, adjusted.cameras)
    )
    # No more than their share of eight cameras.
    assert np.linalg.norm(np.nanmean(after - before, axis=(0, 1, 2))) < 0.3 * 2 / 8
