"""The gradient of the objective is that of its cost."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body_fitting.bones import Shape, measure_bones, pool_shapes
from worldpose.body_fitting.evidence import Contacts, PersonEvidence
from worldpose.body_fitting.pose_space import GATHER, load_pose_prior
from worldpose.body_fitting.residuals import PersonObjective, Pose
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.standing import find_standing_distance


@pytest.fixture
def track():
    rng = np.random.default_rng(5)
    truth = walker(5, rng)
    joints, covariance = seen(truth, 0.02, rng)
    joints[1, 0, 4] = np.nan
    settings = BodyFittingSettings()
    contacts = Contacts(np.ones((5, 2)), np.ones((4, 2)), np.full((5, 2), 0.07))
    evidence = PersonEvidence.of(joints[:, 0], covariance[:, 0], 50.0, settings)
    chained = ChainedKeypoints.of(KEYPOINTS)
    made = PersonObjective(
        chained, evidence, load_pose_prior(), settings, 50.0, 10.0, 0.03, contacts
    )
    angles = truth.body_pose @ GATHER.T + 0.1 * rng.standard_normal((5, 30))
    pose = Pose(truth.transl + 0.01, truth.global_orient, angles, truth.betas[0])
    return made, pose


def test_gradient_by_frames_and_betas_agrees_with_finite_differences(track):
    made, pose = track
    rng = np.random.default_rng(1)
    at = made.equations(pose, np.zeros((17, 3)), bordered=True)
    small = 1e-6
    for _ in range(5):
        step, betas = rng.standard_normal((5, 36)), rng.standard_normal(MODEL.shapes)
        costs = [
            made.equations(
                pose.apply_step(sign * small * step, sign * small * betas),
                np.zeros((17, 3)),
                bordered=True,
            ).cost
            for sign in (1.0, -1.0)
        ]
        slope = (costs[0] - costs[1]) / (2.0 * small)
        expected = (at.gradient * step).sum() + at.border_gradient[: MODEL.shapes] @ betas
        # Betas feel the smoothness only through the poses, so that it does not shorten limbs,
        # and offsets turn with the pose: both are left out, a hundredth of the whole.
        assert slope == pytest.approx(expected, rel=0.02, abs=0.02 * np.abs(at.gradient).sum())


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


FPS, SLOPE = 50.0, 0.2


def find(distance):
    return find_standing_distance(distance, np.full(len(distance), SLOPE), FPS, 0.01)


def test_feet_in_the_air_do_not_make_a_runner_too_distant():
    rng = np.random.default_rng(0)
    time = np.arange(300) / FPS
    true = 70.0 + 3.0 * time
    # Stands for 0.15 s, then flies for 0.15 s with a lift up to 8 cm.
    phase = np.mod(time, 0.3) / 0.3
    lift = 0.08 * np.where(phase > 0.5, np.sin(2.0 * np.pi * (phase - 0.5)), 0.0)
    found, variance = find(true + lift / SLOPE + rng.normal(0.0, 0.05, 300))
    assert abs(np.mean(found - true)) < 0.5 * np.mean(lift) / SLOPE
    assert np.mean(np.abs(found - true) < 2.0 * np.sqrt(variance)) > 0.8


def test_a_standing_person_has_the_mean_distance_and_gaps_are_bridged():
    rng = np.random.default_rng(1)
    seen = 60.0 + rng.normal(0.0, 0.05, 200)
    seen[80:120] = np.nan
    found, variance = find(seen)
    assert np.abs(found - 60.0).max() < 0.15
    assert variance[100] > 2.0 * variance[40]


def test_short_tracks_have_a_distance():
    for frames in (1, 2, 3):
        found, variance = find(np.full(frames, 50.0))
        np.testing.assert_allclose(found, 50.0, atol=0.01)
        assert (variance > 0.0).all()
