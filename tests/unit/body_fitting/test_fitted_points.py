"""Heels and toes bend ankles and toes of fitted bodies, beside their offsets from the body's."""

from dataclasses import replace

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from data_contracts.conventions import FEET
from worldpose.body.keypoints import fold_keypoints
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.extra_points import perceived_points
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.triangulation.results import ExtraJoints

POINTS = fold_keypoints(MODEL, FEET)
SETTINGS = BodyFittingSettings()
NOISE = 0.01
BIAS = 0.024
LEFT = np.array([[0.0, 0.0, 0.02], [0.015, 0.0, 0.01], [0.0, 0.01, -0.02]])
OFFSETS = np.concatenate([LEFT, LEFT * [-1.0, 1.0, 1.0]])
"""Of a shoe: toes ahead and to the side, heel behind [m]: left, up, forward."""


def people(count, frames, seed, *, offsets=0.0):
    """Walkers who roll their feet: bodies, evidence with feet."""
    rng = np.random.default_rng(seed)
    bodies = []
    for n in range(count):
        body = walker(frames, rng)
        pose = body.body_pose.copy()
        wave = np.sin(2.0 * np.pi * 1.2 * np.arange(frames) / 50.0 + n)
        for joint, sign in ((7, 1.0), (8, -1.0)):
            pose[:, 3 * (joint - 1)] = 0.15 + 0.4 * sign * wave
            pose[:, 3 * (joint - 1) + 1] = 0.15 * sign
        bodies.append(replace(body, body_pose=pose))
    joints, covariance, feet = [], [], []
    for body in bodies:
        own, spread = seen(body, NOISE, rng)
        joints.append(own)
        covariance.append(spread)
        there = POINTS(body) + perceived_points(MODEL, FEET, body, offsets * np.ones((6, 3)))
        feet.append(there + NOISE * rng.standard_normal(there.shape))
    places = np.stack(feet, axis=1)
    stated = np.broadcast_to((NOISE**2 + BIAS**2) * np.eye(3), (*places.shape, 3)).copy()
    views = np.full(places.shape[:3], 4, np.uint8)
    extra = ExtraJoints(FEET, places, stated, views, np.full(6, BIAS))
    evidence = ClipEvidence(
        np.concatenate(joints, axis=1), np.concatenate(covariance, axis=1), 50.0, extra=extra
    )
    return bodies, evidence


def errors(fit, bodies):
    """Mean error of heels and toes, and of ankles [m]."""
    truth = np.stack([POINTS(body) for body in bodies], axis=1)
    ankles = np.stack([KEYPOINTS(body)[:, 15:] for body in bodies], axis=1)
    feet = np.linalg.norm(POINTS(fit.parameters) - truth, axis=-1).mean()
    return feet, np.linalg.norm(fit.joints[:, :, 15:] - ankles, axis=-1).mean()


@pytest.fixture(scope="module")
def walk():
    return people(2, 60, 1)


def test_rolling_feet_are_fitted(walk):
    bodies, evidence = walk
    without = fit_bodies(MODEL, replace(evidence, extra=None), SETTINGS)
    with_feet = fit_bodies(MODEL, evidence, SETTINGS)
    assert without.extra is None and with_feet.extra.points == FEET
    before, ankles_before = errors(without, bodies)
    after, ankles_after = errors(with_feet, bodies)
    assert before > 0.04 and after < 0.012
    assert ankles_after < ankles_before
    np.testing.assert_allclose(with_feet.extra.joints, POINTS(with_feet.parameters), atol=1e-12)
    np.testing.assert_array_equal(without.betas, with_feet.betas)  # they determine no shape


def test_offsets_of_shoes_are_learned_and_do_not_move_the_ankles():
    bodies, evidence = people(3, 60, 2, offsets=OFFSETS)
    fit = fit_bodies(MODEL, evidence, SETTINGS)
    # A turn of the foot moves all its points: what it explains is no offset.
    length = fit.extra.offsets[0, 2] - fit.extra.offsets[2, 2]
    assert length == pytest.approx(OFFSETS[0, 2] - OFFSETS[2, 2], abs=0.012)
    np.testing.assert_allclose(
        fit.extra.offsets[:3], fit.extra.offsets[3:] * [-1.0, 1.0, 1.0], atol=1e-12
    )
    feet, ankles = errors(fit, bodies)
    assert feet < 0.02 and ankles < 0.015
