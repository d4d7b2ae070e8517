"""Betas from bone lengths (S1): exact for the blended bone, free of what noise adds."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL

from worldpose.body import BodyParameters
from worldpose.body_fitting.bones import BONES, BoneLengths, fit_shape, measure_bones


def bones_of(betas):
    """Exact lengths of a body's bones [m]."""
    rest = BodyParameters(betas, np.zeros(3), np.zeros(69), np.zeros(3))
    joints = KEYPOINTS(rest)
    return np.array([np.linalg.norm(joints[b] - joints[a]) for a, b in BONES])


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
    measured = measure_bones(joints, covariance, witnesses=1.0)
    # 68 mm of a difference along the bone over 4000 frames: 1.1 mm; four of these.
    assert measured.length[0] == pytest.approx(0.28, abs=0.0045)
    assert np.sqrt(measured.variance[0]) == pytest.approx(0.0011, rel=0.3)


def test_gross_errors_of_some_frames_do_not_count():
    joints = np.zeros((100, 17, 3))
    joints[:, 7] = [0.0, 0.28, 0.0]
    joints[::10, 7] = [0.0, 3.0, 0.0]
    joints[:, 7, 1] += 0.001 * np.random.default_rng(0).standard_normal(100)
    covariance = np.broadcast_to(1e-6 * np.eye(3), (*joints.shape, 3))
    # 1 mm over 90 frames is 0.1 mm.
    assert measure_bones(joints, covariance, 1.0).length[0] == pytest.approx(0.28, abs=5e-4)


def test_the_shortened_bone_of_a_negative_beta_is_short():
    # The printed formula would add the length of the direction: longer for either sign.
    for beta in (-2.0, 2.0):
        betas = np.r_[beta, np.zeros(9)]
        lengths = bones_of(betas)
        shape = fit_shape(MODEL, BoneLengths(lengths, np.full(len(BONES), 1e-8)))
        # The prior and 2 cm of definition hold back; height follows to a tenth of beta's 0.2 m.
        assert shape.betas[0] == pytest.approx(beta, abs=0.5)
        assert np.abs(bones_of(shape.betas) - lengths).max() < 0.01


def test_without_bones_betas_are_those_of_anybody():
    shape = fit_shape(MODEL, BoneLengths(np.full(len(BONES), np.nan), np.full(len(BONES), np.inf)))
    np.testing.assert_array_equal(shape.betas, 0.0)
    np.testing.assert_array_equal(shape.covariance, np.eye(10))
