"""Weights of people and markings in the adjustment."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.bundle_adjustment.clip import select_observations
from worldpose.bundle_adjustment.problems import (
    KeypointNoise,
    camera_knowledge,
    estimate_noise,
    estimate_variance_factor,
    players_problem,
)
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, GivenCameraPrior
from worldpose.bundle_adjustment.solver import solve
from worldpose.static_calibration.parameters import PARAMETERS

SETTINGS = BundleAdjustmentSettings()


def observations(made):
    people = np.ones(made.detections.detection_index.shape[2], dtype=bool)
    return select_observations(made, np.arange(len(made.detections.frame)), people, made.cameras, 3)


def test_the_prior_is_the_inverse_of_what_calibration_knows(clip):
    made, *_ = clip()
    information, free = camera_knowledge(made, SETTINGS)
    k3 = PARAMETERS.index("k3")
    assert free[:, :k3].all()
    assert not free[:, k3].any()
    product = information[0] @ made.covariance[0]
    # Both are diagonal; twelve digits are far more than rounding leaves uncertain.
    np.testing.assert_allclose(product, np.diag(free[0].astype(float)), atol=1e-12)


def test_a_given_camera_moves_in_pose_and_focal_length_alone(clip):
    made, *_ = clip(noise=0.0)
    made = replace(made, covariance=np.zeros_like(made.covariance))
    settings = BundleAdjustmentSettings(given=GivenCameraPrior(center=0.004))
    information, free = camera_knowledge(made, settings)
    assert [PARAMETERS[k] for k in np.flatnonzero(free[0])] == [
        *("rx", "ry", "rz", "tx", "ty", "tz", "log_focal")
    ]
    # The cameras stand 52 m from the middle: 0.2 m.
    assert 1.0 / np.sqrt(information[0, 3, 3]) == pytest.approx(0.2, rel=0.15)


def test_observations_are_those_of_joints_that_enough_cameras_agree_on(clip):
    made, *_ = clip(cameras=4, persons=2, frames=3)
    made.views[:] = 4
    made.views[1, 0, 5] = 2
    observed = observations(made)
    expected = int((np.isfinite(made.joints[..., 0]) & (made.views >= 3)).sum())
    assert expected > 50
    assert len(observed.points) == expected
    assert len(observed.image) == 4 * expected
    assert (np.diff(observed.point_of) >= 0).all()
    for o in (0, 1, len(observed.image) - 1):
        frame, person, joint = observed.frame_of[o], observed.person_of[o], observed.joint_of[o]
        np.testing.assert_array_equal(
            observed.image[o],
            made.detections.keypoints[frame, observed.camera_of[o], person, joint],
        )
        np.testing.assert_array_equal(
            observed.points[observed.point_of[o]], made.joints[frame, person, joint]
        )


def test_lasting_errors_count_as_one(clip):
    made, *_ = clip()
    observed = observations(made)
    fixed = np.zeros(5, dtype=bool)
    once = players_problem(made, observed, KeypointNoise(1.0, 1.0), fixed, SETTINGS)
    lasting = players_problem(made, observed, KeypointNoise(2.0, 4.0), fixed, SETTINGS)
    np.testing.assert_allclose(lasting.weight, once.weight / 16.0)
    # Three standard deviations stay three: the weight has the correlation in it.
    np.testing.assert_allclose(lasting.scale, once.scale / 2.0)


@pytest.mark.parametrize(("noise", "lasting"), [(1.0, 0.0), (0.6, 1.2)])
def test_scale_and_correlation_of_errors_are_found(clip, noise, lasting):
    made, true, joints = clip(frames=20, noise=noise, lasting=lasting, seed=3)
    observed = observations(made)
    points = joints[made.views >= 3]
    found = estimate_noise(true, points, observed, robust_scale=100.0)
    # 10,200 observations about the truth: the views' share is taken off for nothing here, 1 in
    # 1 - 3 / (2 x 5) = 0.7; the rest is right to a per cent.
    expected = np.hypot(noise, lasting) / np.sqrt(0.7)
    assert found.scale == pytest.approx(expected, rel=0.03)
    # 20 equal errors among the others: (20 lasting^2 + noise^2) / (lasting^2 + noise^2); 510
    # series tell that to 5 %.
    share = (20.0 * lasting**2 + noise**2) / (lasting**2 + noise**2)
    assert found.correlation == pytest.approx(share, rel=0.15)


@pytest.mark.parametrize("claimed", [1.0, 0.2])
def test_calibration_that_claims_too_much_is_doubted_as_much(clip, claimed):
    made, *_ = clip(persons=8, seed=6)
    sure = replace(made, covariance=claimed**2 * made.covariance)
    nobody = np.zeros(5, dtype=bool)
    problem = players_problem(sure, observations(made), KeypointNoise(), nobody, SETTINGS)
    variance_factor = estimate_variance_factor(problem, solve(problem))
    # Some 40 directions of five cameras tell a variance to a factor of 1.25; and one's own word
    # counts for another ten, which draws large factors down.
    assert 0.4 / claimed**2 < variance_factor.mean() < 1.6 / claimed**2
