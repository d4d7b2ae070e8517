"""Metrics over a clip's frames, counted by hand."""

import numpy as np

from worldpose.review.evidence import clip_curves


def test_each_frame_is_counted_on_its_own():
    bodies = np.zeros((3, 2, 17, 3))
    bodies[1, 1] = bodies[2] = np.nan  # two people, one, none
    placed = bodies + np.array([0.02, 0.0, 0.0])
    placed[0, 1] = np.nan
    variance = np.where(np.isfinite(bodies), 1.0, np.nan)[..., None] * np.diag([1e-4, 4e-4, 4e-4])
    filled = np.array([[False, True], [False, False], [True, False]])
    people, share, deviation, apart = (
        curve.values for curve in clip_curves(bodies, variance, filled, placed)
    )
    assert people.tolist() == [2.0, 1.0, 0.0]
    np.testing.assert_allclose(share, [0.5, 0.0, np.nan])
    np.testing.assert_allclose(deviation, [3e-4**0.5, 3e-4**0.5, np.nan])
    # 2 cm along one of three axes.
    np.testing.assert_allclose(apart, [0.02 / 3**0.5] * 2 + [np.nan])
