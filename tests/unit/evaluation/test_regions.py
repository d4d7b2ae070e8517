"""Stated confidence regions against truth."""

import numpy as np
import pytest
from joint_regions import region_counts

from worldpose.formats.joints_file import JointTracks


def people(frames=60, persons=4, spread=0.03, stated=0.03, seed=0):
    """True people 3 m apart, and predictions with normal errors of a known size."""
    rng = np.random.default_rng(seed)
    true = rng.normal(0.0, 0.4, (frames, persons, 17, 3))
    true[..., 0] += 3.0 * np.arange(persons)[:, None]
    covariance = np.broadcast_to(stated**2 * np.eye(3), (*true.shape, 3)).copy()
    found = true + spread * rng.standard_normal(true.shape)
    numbers, ids = np.arange(frames), np.arange(persons)
    return JointTracks(numbers, ids, found, covariance), JointTracks(numbers, ids, true)


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_regions_of_the_true_size_hold_the_stated_share(level):
    found = region_counts(*people(), level)
    inside, count = np.array(list(found.values())).sum(axis=0)
    assert count == 60 * 4 * 17
    assert inside / count == pytest.approx(level, abs=0.02)
