"""Points besides COCO-17 are triangulated like joints, and change none of them."""

import numpy as np
import pytest

from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.triangulation.estimate import reconstruct_joints, triangulate_joints
from worldpose.triangulation.noise_model import shared_variance
from worldpose.triangulation.settings import TriangulationSettings

NOISE = 2.0
FPS = 50.0


@pytest.fixture
def clip(ring, seen):
    """Six cameras, two people; true points (frames, persons, 6, 3) and noisy detections."""
    rng = np.random.default_rng(5)
    cameras = ring(6)
    time = np.arange(60)[:, None, None, None] / FPS
    body = rng.uniform(-0.4, 0.4, (1, 2, 23, 3)) + [[[0.0, 0.0, 1.0]]]
    places = (
        body + np.array([0.0, 0.0, 0.0, 4.0]).reshape(1, 2, 1, 2)[..., :1] + time * [1.0, 0.5, 0.0]
    )
    keypoints, confidence, index = seen(cameras, places)
    keypoints = keypoints + NOISE * rng.standard_normal(keypoints.shape)
    detections = KeypointDetections.from_keypoints(
        keypoints[..., :17, :], confidence[..., :17], index
    )
    feet = keypoints[..., 17:, :], confidence[..., 17:]
    return cameras, detections, detections.add_points(FEET, *feet), places[..., 17:, :]


def test_joints_are_bit_for_bit_those_without_points(clip):
    cameras, plain, with_feet, _ = clip
    one, two = (reconstruct_joints(cameras, each[:20], FPS) for each in (plain, with_feet))
    assert one.triangulation.extra is None
    for name in ("joints", "covariance", "views", "inliers", "exchanged", "offsets"):
        np.testing.assert_array_equal(
            getattr(one.triangulation, name), getattr(two.triangulation, name)
        )
    np.testing.assert_array_equal(one.smoothing.joints, two.smoothing.joints)


def test_points_are_found_within_their_noise(clip):
    cameras, _, with_feet, truth = clip
    found = triangulate_joints(cameras, with_feet, replace_settings(offsets="none")).extra
    assert found.points == FEET and found.joints.shape == truth.shape
    away = found.joints - truth
    # 30 m away at 1500 px, 2 px are 40 mm across one ray; six views leave half of that.
    assert 0.01 < np.sqrt((away**2).mean()) < 0.03
    seen = (with_feet.detection_index >= 0).sum(axis=1)
    bias = shared_variance(found.common_bias, found.views, seen)
    random = found.covariance - bias[..., None, None] * np.eye(3)
    square = np.einsum("fpka,fpkab,fpkb->fpk", away, np.linalg.inv(random), away)
    assert 2.4 < square.mean() < 3.6  # chi-square of three degrees of freedom
    assert (found.views >= 5).mean() > 0.95


def replace_settings(**changes):
    return TriangulationSettings().model_copy(update=changes)
