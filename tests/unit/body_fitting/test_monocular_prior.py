"""Monocular poses in the objective: their derivatives, and how far they are believed."""

from dataclasses import replace

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body_fitting import BodyFittingSettings, fit_bodies
from worldpose.body_fitting.monocular_poses import MonocularPoses
from worldpose.body_fitting.monocular_prior import (
    DOUBT,
    FRESH,
    Guidance,
    carry_errors,
    learn_precision,
    left_jacobian,
)
from worldpose.body_fitting.pose_space import GATHER
from worldpose.geometry import Rigid

RNG = np.random.default_rng(2)


def rotation(vectors):
    return Rigid.from_rotvec(vectors, np.zeros(3)).rotation


def test_left_jacobian_agrees_with_finite_differences():
    vectors = RNG.normal(0.0, 1.0, (6, 3))
    vectors[0] = 0.0
    exact = left_jacobian(vectors)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        turned = rotation(vectors + step) @ rotation(vectors - step).swapaxes(-1, -2)
        slope = Rigid(turned, np.zeros(3)).rotvec / 2e-6
        # Central differences: 1e-12, over a step of 1e-6 rounding of 1e-10.
        np.testing.assert_allclose(exact[:, :, axis], slope, atol=1e-8)


def test_the_pull_is_the_gradient_of_its_cost():
    orient, angles = RNG.normal(0.0, 0.8, (4, 3)), RNG.normal(0.0, 0.5, (4, 30))
    known = rotation(orient + RNG.normal(0.0, 0.3, (4, 3)))
    precision = np.diag(RNG.uniform(5.0, 50.0, 33))
    used = np.array([True, True, False, True])
    known_angles = angles + RNG.normal(0.0, 0.3, (4, 30))
    known_angles[2] = np.nan
    left = RNG.uniform(0.4, 1.0, 4)
    guidance = Guidance(known, known_angles, used, precision, 20.0, left)
    step = RNG.standard_normal((4, 33))
    gradient = guidance.pull(orient, angles)[1]
    costs = [
        guidance.pull(orient + sign * 1e-6 * step[:, :3], angles + sign * 1e-6 * step[:, 3:])[2]
        for sign in (1.0, -1.0)
    ]
    assert (gradient * step).sum() == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-6)
    np.testing.assert_array_equal(gradient[2], 0.0)


@pytest.mark.parametrize("error", [0.05, 0.6])
def test_methods_are_believed_as_far_as_they_agree_where_the_truth_is_known(error):
    orient, angles = RNG.normal(0.0, 0.5, (400, 1, 3)), RNG.normal(0.0, 0.5, (400, 1, 30))
    off = error * RNG.standard_normal((400, 1, 33))
    glimpses = MonocularPoses(rotation(off[..., :3]) @ rotation(orient), angles + off[..., 3:])
    sure = np.ones((400, 1), dtype=bool)
    spread = 1.0 / np.sqrt(np.diag(learn_precision(glimpses, orient, angles, sure, 1.0)))
    # Five of 0.25 rad are counted with 400: 56 mrad for 50; 1 / sqrt(800) is 4 %, three of these.
    expected = np.sqrt((5.0 * DOUBT**2 + 400.0 * error**2) / 405.0)
    np.testing.assert_allclose(spread[3:], expected, rtol=0.12)
    none = learn_precision(glimpses, orient, angles, ~sure, 1.0)
    np.testing.assert_allclose(none, np.eye(33) / DOUBT**2)


def people_in_a_gap(seed=5):
    """A walker whose arms and legs nobody triangulates for a second, and his true bodies."""
    rng = np.random.default_rng(seed)
    truth = walker(100, rng)
    joints, covariance = seen(truth, 0.01, rng)
    joints[30:80, :, 7:11] = np.nan
    joints[30:80, :, 13:17] = np.nan
    return truth, joints, covariance


def glimpsed(truth, error, rng):
    orient = rotation(truth.global_orient)[:, None]
    angles = (truth.body_pose @ GATHER.T)[:, None]
    return MonocularPoses(orient, angles + error * rng.standard_normal(angles.shape))


def test_right_glimpses_help_where_joints_are_missing_and_are_recorded():
    truth, joints, covariance = people_in_a_gap()
    settings = BodyFittingSettings()
    glimpses = glimpsed(truth, 0.1, np.random.default_rng(1))
    alone = fit_bodies(MODEL, joints, covariance, 50.0, settings)
    guided = fit_bodies(MODEL, joints, covariance, 50.0, settings, glimpses=glimpses)
    np.testing.assert_array_equal(np.flatnonzero(guided.guided[:, 0]), np.arange(30, 80))
    assert not alone.guided.any()
    exact = KEYPOINTS(truth)[:, None]
    before, after = (
        np.linalg.norm(x.joints - exact, axis=-1)[35:75].mean() for x in (alone, guided)
    )
    assert after < 0.8 * before


def test_wrong_glimpses_harm_little():
    truth, joints, covariance = people_in_a_gap()
    settings = BodyFittingSettings()
    glimpses = glimpsed(truth, 1.0, np.random.default_rng(1))
    alone = fit_bodies(MODEL, joints, covariance, 50.0, settings)
    guided = fit_bodies(MODEL, joints, covariance, 50.0, settings, glimpses=glimpses)
    exact = KEYPOINTS(truth)[:, None]
    before, after = (
        np.linalg.norm(x.joints - exact, axis=-1)[35:75].mean() for x in (alone, guided)
    )
    # Angles wrong by a radian in every frame: noise, half of which averages away.
    assert after < 1.5 * before


def test_who_turned_unseen_is_found_from_pictures_that_miss_every_eighth_frame():
    rng = np.random.default_rng(5)
    truth = walker(100, rng)
    about = np.zeros((100, 3))
    about[:, 2] = np.radians(300.0) * np.clip((np.arange(100) - 30) / 40.0, 0.0, 1.0)
    turned = Rigid(rotation(about) @ rotation(truth.global_orient), np.zeros(3)).rotvec
    truth = replace(truth, global_orient=turned)
    joints, covariance = seen(truth, 0.01, rng)
    joints[30:70] = np.nan
    glimpses = glimpsed(truth, 0.1, rng)
    missed = (np.arange(100) % 8 == 0)[:, None, None]
    glimpses = MonocularPoses(
        np.where(missed[..., None], np.nan, glimpses.orient),
        np.where(missed, np.nan, glimpses.angles),
    )
    fit = fit_bodies(MODEL, joints, covariance, 50.0, BodyFittingSettings(), glimpses=glimpses)
    away = rotation(fit.parameters.global_orient[30:70, 0]) @ rotation(turned[30:70]).swapaxes(1, 2)
    # The shorter way round between the ends is the other way, 180 degrees off in the middle.
    assert np.degrees(np.linalg.norm(Rigid(away, np.zeros(3)).rotvec, axis=-1)).max() < 20.0


def test_what_pictures_get_wrong_before_and_after_is_taken_off_between():
    spread, lasting = 0.1, 25.0
    used = np.zeros(120, dtype=bool)
    used[40:80] = True
    keeps = np.exp(-1.0 / lasting)
    squares, shares = [], []
    for _ in range(100):
        slow = RNG.standard_normal((120, 33))
        for frame in range(1, 120):
            slow[frame] = keeps * slow[frame - 1] + np.sqrt(1.0 - keeps**2) * slow[frame]
        off = np.sqrt(1.0 - FRESH) * slow + np.sqrt(FRESH) * RNG.standard_normal((120, 33))
        off *= spread
        estimated = rotation(-off[:, :3]), -off[:, 3:]
        known = np.where(used[:, None], np.nan, off)
        turn, angles, left = carry_errors(*estimated, known, used, lasting)
        np.testing.assert_array_equal(turn[~used], estimated[0][~used])
        wrong = np.concatenate([Rigid(turn, np.zeros(3)).rotvec, angles], axis=-1)
        squares.append((wrong[used] ** 2).mean(axis=-1) / spread**2)
        shares.append(left[used])
    found, told = np.mean(squares, axis=0), np.mean(shares, axis=0)
    # 3300 draws for each frame: 2.5 %, four of these. Turns that do not commute add less.
    np.testing.assert_allclose(found, told, rtol=0.1)
    assert told[0] < 0.75
    assert told[-1] < 0.75
    assert told[20] > told[0] + 0.1


def test_nothing_is_taken_off_where_no_frame_tells():
    orient, angles = rotation(RNG.normal(0.0, 0.5, (9, 3))), RNG.normal(0.0, 0.5, (9, 30))
    nothing = np.full((9, 33), np.nan)
    turn, bent, left = carry_errors(orient, angles, nothing, np.ones(9, dtype=bool), 12.5)
    np.testing.assert_array_equal(turn, orient)
    np.testing.assert_array_equal(bent, angles)
    np.testing.assert_array_equal(left, 1.0)
