"""Betas from bone lengths (S1): exact for the blended bone, free of what noise adds."""

import numpy as np
import pytest

from worldpose.body_fitting.bones import Shape, measure_bones, pool_shapes


def test_a_person_of_several_clips_is_what_they_say_together_with_anybody_counted_once():
    # Each clip knows the first component to 0.5 besides the prior: 1 / (1 + 4) of variance.
    covariance = np.diag([0.2, 1.0])
    clips = [Shape(np.array([0.8 * seen, 0.0]), covariance) for seen in (1.0, 2.0)]
    pooled = pool_shapes(clips, 1.0)
    # Two correlated_frames of precision 4 and the prior's 1: (4 x 1 + 4 x 2) / 9.
    np.testing.assert_allclose(pooled.betas, [12.0 / 9.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pooled.covariance, np.diag([1.0 / 9.0, 1.0]), atol=1e-12)


def test_noise_lengthens_bones_and_the_lengths_here_are_without_it():
    rng = np.random.default_rng(3)
    joints = np.zeros((4000, 17, 3))
    joints[:, 7] = [0.0, 0.0, 0.28]
    noise = 0.048
    joints = joints + noise * rng.standard_normal(joints.shape)
    upper_arm = np.linalg.norm(joints[:, 7] - joints[:, 5], axis=-1)
    # 2 axes across x 2 joints x variance / (2 x length): 16 mm too long, to first order.
    assert upper_arm.mean() - 0.28 == pytest.approx(2.0 * noise**2 / 0.28, abs=0.004)
    covariance = np.broadcast_to(noise**2 * np.eye(3), (*joints.shape, 3))
    measured = measure_bones(joints, covariance, correlated_frames=1.0)
    # 68 mm of a difference along the bone over 4000 frames: 1.1 mm; four of these.
    assert measured.length[0] == pytest.approx(0.28, abs=0.0045)
    assert np.sqrt(measured.variance[0]) == pytest.approx(0.0011, rel=0.3)
