"""Betas from bone lengths (S1): exact for the blended bone, free of what noise adds."""

import numpy as np

from worldpose.body_fitting.bones import Shape, pool_shapes


def test_a_person_of_several_clips_is_what_they_say_together_with_anybody_counted_once():
    # Each clip knows the first component to 0.5 besides the prior: 1 / (1 + 4) of variance.
    covariance = np.diag([0.2, 1.0])
    clips = [Shape(np.array([0.8 * seen, 0.0]), covariance) for seen in (1.0, 2.0)]
    pooled = pool_shapes(clips, 1.0)
    # Two correlated_frames of precision 4 and the prior's 1: (4 x 1 + 4 x 2) / 9.
    np.testing.assert_allclose(pooled.betas, [12.0 / 9.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pooled.covariance, np.diag([1.0 / 9.0, 1.0]), atol=1e-12)
