"""Heels and toes bend ankles and toes of fitted bodies, beside their offsets from the body's."""

from dataclasses import replace

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from data_contracts.conventions import FEET
from worldpose.body.keypoints import LANDMARKS, fold_keypoints, point_segments
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


def test_a_foot_without_points_stands_as_before(walk):
    """On the ground a foot whose points are missing for long is level, the other is as seen."""
    bodies, evidence = walk
    joints = evidence.extra.joints.copy()
    joints[:, :, 3:] = np.nan
    extra = replace(evidence.extra, joints=joints)

    def ground(x, y):
        return np.zeros(np.shape(x)) - 0.25

    both = [
        fit_bodies(MODEL, replace(evidence, extra=each), SETTINGS, ground) for each in (extra, None)
    ]
    left, right = (slice(3 * (joint - 1), 3 * joint) for joint in (7, 8))
    poses = [fit.parameters.body_pose for fit in both]
    apart = [np.abs(poses[0][..., foot] - poses[1][..., foot]).mean() for foot in (left, right)]
    assert apart[0] > 0.1 and apart[1] < 0.02
    truth = bodies[0].body_pose[:, left]
    assert np.abs(poses[0][:, 0, left] - truth).mean() < 0.12


LANDMARK_POINTS = tuple(LANDMARKS)
ON_BODY = fold_keypoints(MODEL, LANDMARK_POINTS)


def landmarks(bodies, evidence, wobble_m, seed=7):
    """Evidence with landmarks; those of one segment err alike, by a slow wobble [m]."""
    rng = np.random.default_rng(seed)
    segment = point_segments(MODEL, LANDMARK_POINTS)
    frames = evidence.joints.shape[0]
    time = np.arange(frames) / 50.0
    each = []
    for body in bodies:
        phase, way = rng.uniform(0, 2 * np.pi, 24), rng.standard_normal((24, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        sway = np.sin(2.0 * np.pi * 1.5 * time[:, None] + phase)[..., None] * way
        places = ON_BODY(body) + wobble_m * sway[:, segment]
        each.append(places + 0.003 * rng.standard_normal(places.shape))
    places = np.stack(each, axis=1)
    stated = np.broadcast_to((0.003**2 + BIAS**2) * np.eye(3), (*places.shape, 3)).copy()
    views = np.full(places.shape[:3], 4, np.uint8)
    bias = np.full(len(LANDMARK_POINTS), BIAS)
    return replace(evidence, extra=ExtraJoints(LANDMARK_POINTS, places, stated, views, bias))


def joint_error(fit, bodies):
    truth = np.stack([KEYPOINTS(body) for body in bodies], axis=1)
    return np.linalg.norm(fit.joints - truth, axis=-1).mean()


def test_accurate_landmarks_make_bodies_better(walk):
    bodies, evidence = walk
    plain = joint_error(fit_bodies(MODEL, replace(evidence, extra=None), SETTINGS), bodies)
    better = joint_error(fit_bodies(MODEL, landmarks(bodies, evidence, 0.0), SETTINGS), bodies)
    assert better < 0.9 * plain
