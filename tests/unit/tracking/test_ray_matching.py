import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldpose.tracking.ray_matching import match_optimally


@given(seed=st.integers(0, 10_000))
@settings(max_examples=50)
def test_optimal_matching_has_the_largest_gain_of_all(seed):
    rng = np.random.default_rng(seed)
    affinity = -rng.uniform(0, 1, (1, 3, 4))
    affinity[rng.random(affinity.shape) < 0.3] = -np.inf
    index = match_optimally(affinity, -0.8)[0]

    def gain(places):
        return sum(-0.8 if d < 0 else affinity[0, p, d] for p, d in enumerate(places))

    every = (
        choice
        for choice in itertools.product(range(-1, 4), repeat=3)
        if len({d for d in choice if d >= 0}) == sum(d >= 0 for d in choice)
    )
    # Sums of three numbers of size 1.
    assert gain(index.tolist()) == pytest.approx(max(map(gain, every)), abs=1e-12)
