"""The gradient of the objective is that of its cost."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body_fitting.bones import Shape, agree, pool_shapes
from worldpose.body_fitting.evidence import Contacts, PersonEvidence
from worldpose.body_fitting.pose_space import GATHER, load_pose_prior
from worldpose.body_fitting.residuals import PersonObjective, Pose
from worldpose.body_fitting.settings import BodyFittingSettings


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
    # One in a thousand pairs of clips of one person is farther apart, 13.8 of two betas.
    limit = np.sqrt(13.8 * 0.4)
    for apart, said in ((limit, True), (limit + 0.01, False)):
        assert agree(clips[0], Shape(clips[0].betas + [apart, 0.0], covariance)) == said
