"""Stated confidence regions against truth."""

from dataclasses import replace

import numpy as np
import pytest
from joint_regions import region_counts

from worldpose.formats.joints_file import JointTracks


def people(frames=60, persons=4):
    """True people 3 m apart, and predictions with normal errors of a known size."""
    rng = np.random.default_rng(0)
    true = rng.normal(0.0, 0.4, (frames, persons, 17, 3))
    true[..., 0] += 3.0 * np.arange(persons)[:, None]
    covariance = np.broadcast_to(0.03**2 * np.eye(3), (*true.shape, 3)).copy()
    found = true + 0.03 * rng.standard_normal(true.shape)
    numbers, ids = np.arange(frames), np.arange(persons)
    return JointTracks(numbers, ids, found, covariance), JointTracks(numbers, ids, true)


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_regions_of_the_true_size_hold_the_stated_share(level):
    found = region_counts(*people(), level)
    inside, count = np.array(list(found.values())).sum(axis=0)
    assert count == 60 * 4 * 17
    assert inside / count == pytest.approx(level, abs=0.02)


def test_missing_joints_frames_and_unseen_joints_do_not_count():
    prediction, truth = people(frames=4, persons=2)
    prediction.joints[0, 0, 0] = np.nan
    views = np.full(truth.joints.shape[:3], 3)
    views[1, 1, 1] = 1
    three = {name: getattr(prediction, name)[:3] for name in ("frames", "joints", "covariance")}
    counts = region_counts(replace(prediction, **three), replace(truth, views=views))
    assert sum(total for _, total in counts.values()) == 3 * 2 * 17 - 2
