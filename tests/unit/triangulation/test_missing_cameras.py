"""A camera with NaN is missing: the others place all people as if it were absent."""

from dataclasses import replace

import numpy as np
import pytest
from running_samples import FPS, detections, runner

from data_contracts.keypoints import KeypointDetections
from worldpose.triangulation.estimate import reconstruct_joints
from worldpose.triangulation.settings import TriangulationSettings

GONE = 2


def without(camera, field):
    """The cameras, one of which has a NaN in a field."""
    if field in ("rotation", "translation"):
        value = getattr(camera.cam_from_world, field).copy()
        value[GONE].flat[-1] = np.nan
        return replace(camera, cam_from_world=replace(camera.cam_from_world, **{field: value}))
    value = getattr(camera, field).copy()
    value[GONE, 0] = np.nan
    return replace(camera, **{field: value})


@pytest.mark.parametrize(("field", "known"), [("distortion", False), ("translation", True)])
def test_a_missing_camera_sees_nothing_and_takes_nothing_away(ring, field, known):
    camera = ring(5)
    keypoints, confidence, index = detections(camera, runner(30), 0.5)
    unseen = index.copy()
    unseen[:, GONE] = -1
    settings = TriangulationSettings()
    covariance = np.tile(1e-8 * np.eye(12), (5, 1, 1)) if known else None
    given = (keypoints, confidence)
    expected = reconstruct_joints(
        camera, KeypointDetections.from_keypoints(*given, unseen), FPS, settings, covariance
    )
    found = reconstruct_joints(
        without(camera, field),
        KeypointDetections.from_keypoints(*given, index),
        FPS,
        settings,
        covariance,
    )
    joints = found.triangulation.joints
    assert np.isfinite(joints).all()
    # Confidences are learned from all that was detected, in that camera too.
    np.testing.assert_allclose(joints, expected.triangulation.joints, atol=1e-3)
    np.testing.assert_allclose(found.smoothing.joints, expected.smoothing.joints, atol=1e-3)
    assert not found.triangulation.inliers[:, GONE].any()
    assert not found.triangulation.offsets[:, GONE].any()
