"""The spread of keypoints about bodies, from medians."""

import numpy as np

from worldpose.filtering.judging import LEAST, learn_spread


def test_the_spread_of_joints_and_confidences_is_found_among_wrong_ones():
    rng = np.random.default_rng(8)
    joint = np.linspace(0.5, 2.0, 17)
    confidence = rng.uniform(0.2, 1.0, (4000, 17))
    sigma = np.sqrt(joint * np.where(confidence < 0.6, 2.0, 1.0) * 4.0 + 9.0)
    errors = rng.normal(size=(4000, 17, 2)) * sigma[..., None]
    errors[rng.random((4000, 17)) < 0.05] += 60.0
    spread = learn_spread(
        (errors**2).sum(-1), np.full((4000, 17), 4.0), np.full((4000, 17), 9.0), confidence
    )
    sure, unsure = (spread.factor(np.full(17, each)) for each in (0.95, 0.25))
    # A median of 4,000 is known to 2 % of the whole variance, of which the factor is a third; one
    # wrong in twenty adds 7 % to that.
    np.testing.assert_allclose(sure, joint, rtol=0.35, atol=0.3)
    np.testing.assert_allclose((unsure / sure).mean(), 2.0, rtol=0.2)


def test_bodies_that_follow_every_keypoint_do_not_make_all_of_them_odd():
    seen = np.zeros((50, 17))
    spread = learn_spread(seen, seen + 4.0, seen, seen + 0.5)
    assert (spread.factor(np.full(17, 0.5)) >= LEAST**2).all()


def test_without_keypoints_the_stated_spread_stays():
    nothing = np.full((3, 17), np.nan)
    spread = learn_spread(nothing, nothing, nothing, nothing)
    np.testing.assert_array_equal(spread.factor(np.full((2, 17), 0.5)), 1.0)
