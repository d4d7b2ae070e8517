"""The gradient of the objective is that of its cost."""

from dataclasses import replace

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body_fitting.evidence import (
    MIRRORED_OFFSETS,
    Contacts,
    PersonEvidence,
    find_contacts,
)
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


def test_gradient_by_offsets_agrees_with_finite_differences(track):
    made, pose = track
    at = made.equations(pose, np.zeros((17, 3)), bordered=True)
    unknowns = np.random.default_rng(2).standard_normal(MIRRORED_OFFSETS.shape[-1])
    costs = [
        made.equations(pose, sign * 1e-6 * MIRRORED_OFFSETS @ unknowns, bordered=True).cost
        for sign in (1.0, -1.0)
    ]
    slope = (costs[0] - costs[1]) / 2e-6
    # Central differences of a cost of some thousands: rounding of 1e-12 over 1e-6.
    assert at.border_gradient[MODEL.shapes :] @ unknowns == pytest.approx(slope, rel=1e-5)


def test_a_track_of_two_intervals_has_the_equations_of_both(track):
    made, pose = track
    # Contacts found in the joined intervals do not tie them either: the second is 5 cm off.
    joints = made.chained.differentiate(pose.parameters()).keypoints
    ground, height = (lambda x, _: np.zeros_like(x)), float(joints[:, 15:17, 2].max())

    def equations(poses, evidence, starts=()):
        whole = np.concatenate(
            [made.chained.differentiate(each.parameters()).keypoints for each in poses]
        )
        contacts = find_contacts(whole, height, ground, 0.1, made.settings, starts)
        return replace(made, evidence=evidence, contacts=contacts, starts=starts).equations(
            Pose(
                *(
                    np.concatenate([getattr(each, name) for each in poses])
                    for name in ("transl", "orient", "angles")
                ),
                pose.betas,
            ),
            np.zeros((17, 3)),
            bordered=True,
        )

    moved = replace(pose, transl=pose.transl + [0.05, 0.0, 0.0])
    apart = [equations([each], made.evidence) for each in (pose, moved)]
    both = PersonEvidence(
        np.concatenate([made.evidence.joints] * 2), np.concatenate([made.evidence.information] * 2)
    )
    joined = equations([pose, moved], both, starts=(5,))
    for name, axis in (("blocks", 1), ("gradient", 0), ("border", 0)):
        expected = np.concatenate([getattr(each, name) for each in apart], axis=axis)
        np.testing.assert_allclose(getattr(joined, name), expected, rtol=1e-12, atol=1e-9)
    for name in ("corner", "border_gradient", "cost"):
        expected = getattr(apart[0], name) + getattr(apart[1], name)
        np.testing.assert_allclose(getattr(joined, name), expected, rtol=1e-9, atol=1e-9)
    tied = equations([pose, moved], both)
    assert np.abs(tied.gradient - joined.gradient).max() > 1e-3 * np.abs(joined.gradient).max()
