"""Given cameras, no pitch, people who cross: adjustment improves or refuses, and never drifts."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lab import joint_error, make_lab, triangulated

from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints

CASES = {
    "exact": {},
    "5 mm and 0.05 degrees": {"center": 0.005, "rotation": np.radians(0.05)},
    "5 cm and 0.3 degrees": {"center": 0.05, "rotation": np.radians(0.3)},
    "a focal length 10 % off": {"focal": 1.1},
}
EXACT, SMALL, LARGE, FOCAL = CASES


@cache
def adjusted_lab(seed, case, cameras=4):
    lab = make_lab(seed, cameras=cameras, **CASES[case])
    return lab, adjust_cameras(lab.clip)


@pytest.mark.parametrize(
    ("case", "seed", "cameras"), [(EXACT, 2, 4), (SMALL, 3, 3), (LARGE, 3, 3), (FOCAL, 2, 4)]
)
def test_joints_are_never_worse_than_with_the_given_cameras(case, seed, cameras):
    lab, adjusted = adjusted_lab(seed, case, cameras)
    told = adjusted.covariance if adjusted.accepted.all() else None
    before = triangulated(lab, lab.clip.cameras)
    after = triangulated(lab, adjusted.cameras, told)
    for aligned in (False, True):
        assert joint_error(lab, after, aligned) < joint_error(lab, before, aligned) + 0.001
    if case in (EXACT, SMALL):
        assert not adjusted.accepted.any()
        np.testing.assert_array_equal(adjusted.motion, 0.0)
        assert all(reason.startswith("refused") for reason in adjusted.reasons)


def test_refused_given_cameras_do_not_pull_the_others():
    lab = make_lab(1, cameras=8, center=0.02, rotation=np.radians(0.1))
    # Two cameras err by 5 cm together, and have too few keypoints for a change.
    step = np.zeros((8, 12))
    step[:2, 3:6] = lab.clip.cameras.cam_from_world.rotation[:2] @ [0.05, 0.0, 0.0]
    cameras = step_camera(lab.clip.cameras, step)
    confidence = lab.clip.detections.confidence.copy()
    confidence[:, :2, :, ::2] = 0.0
    seen = replace(lab.clip.detections, confidence=confidence)
    placed = triangulate_joints(cameras, seen, lab.clip.triangulation)
    views = placed.views.astype(np.int64)
    clip = replace(lab.clip, cameras=cameras, detections=seen, joints=placed.joints, views=views)
    adjusted = adjust_cameras(clip, BundleAdjustmentSettings(min_judges=1200))
    np.testing.assert_array_equal(adjusted.accepted, [False] * 2 + [True] * 6)
    np.testing.assert_array_equal(adjusted.cameras.numbers[:2], cameras.numbers[:2])
    others = seen.detection_index.copy()
    others[:, :2] = -1
    lab = lab._replace(clip=replace(clip, detections=seen.assign_people(others)))
    before, after = triangulated(lab, cameras), triangulated(lab, adjusted.cameras)
    # No more than their share of eight cameras.
    assert np.linalg.norm(np.nanmean(after - before, axis=(0, 1, 2))) < 0.05 * 2 / 8
