import math

import numpy as np
import pytest

from worldpose.triangulation.consensus import (
    agreeing,
    best_pair_point,
    consensus,
    graduated_point,
    spread,
)
from worldpose.triangulation.reprojection import deviations

POINT = np.array([0.7, -1.1, 1.3])
NOISE = (1.0, 0.0)
LIMIT = 9.0


@pytest.fixture
def exact(ring):
    """Builds rows and poses of exact views of `POINT` in cameras without a lens."""

    def build(count):
        pose = ring(count).cam_from_world
        cam = pose.apply(POINT[None])[:, 0]
        rows = np.zeros((count, 7))
        rows[:, :2] = cam[:, :2] / cam[:, 2:]
        rows[:, [2, 5, 6]] = 1500.0, 1500.0, 1.0
        poses = np.concatenate([pose.rotation, pose.translation[..., None]], axis=-1)
        return rows, poses.reshape(count, 12)

    return build


def test_limit_itself_agrees():
    assert agreeing(np.array([9.0, 9.1, 0.0, np.inf, np.nan]), 5, LIMIT) == 2


def test_spread_is_the_sine_of_the_widest_angle():
    # Cameras at (0, 0, -1) and (-1, 0, 0), looking along z and x, both towards the origin: a
    # right angle; a third beside the first, 30 degrees.
    poses = np.zeros((3, 12))
    poses[:, [0, 5, 10]] = 1.0
    poses[0, 11] = 1.0
    poses[1] = [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 1]
    poses[2, [3, 11]] = 0.5, math.sqrt(0.75)
    origin = (0.0, 0.0, 0.0)
    assert spread(origin, poses, np.array([1.0, 1.0, 1.0]), 3) == pytest.approx(1.0)
    assert spread(origin, poses, np.array([1.0, 0.0, 1.0]), 3) == pytest.approx(0.5)
    assert spread(origin, poses, np.array([1.0, 0.0, 0.0]), 3) == 0.0


def test_graduated_loss_finds_the_majority_from_far_away(exact):
    rows, poses = exact(8)
    rows[:3, 0] += 0.1
    squared = np.empty(8)
    start = tuple(POINT + 2.0)
    deviations(start, rows, poses, NOISE, 8, squared)
    found = graduated_point(start, rows, poses, np.ones(8), NOISE, 8, LIMIT, squared)
    # An outlier of 150 px at scale 3 px keeps a weight of (9 / 22500)^2 = 2e-7.
    np.testing.assert_allclose(found, POINT, atol=1e-4)
    assert agreeing(squared, 8, LIMIT) == 5


def test_best_pair_ignores_two_wild_views(exact):
    rows, poses = exact(5)
    rows[1, 0] += 0.2
    rows[3, 1] -= 0.15
    found = best_pair_point(rows, poses, np.empty(5), NOISE, 5, LIMIT, np.empty(5))
    np.testing.assert_allclose(found, POINT, atol=1e-9)


def test_consensus_marks_the_views_that_agree(exact):
    rows, poses = exact(3)
    rows[2, 1] += 0.1
    weights = np.empty(3)
    point, count = consensus(rows, poses, NOISE, 3, LIMIT, 2, weights, np.empty(3))
    np.testing.assert_allclose(point, POINT, atol=1e-9)
    assert count == 2
    assert weights.tolist() == [1.0, 1.0, 0.0]


def test_no_consensus_is_nan_and_zero(exact):
    rows, poses = exact(3)
    rows[0, 1] += 0.1
    rows[2, 1] -= 0.1
    point, count = consensus(rows, poses, NOISE, 3, LIMIT, 2, np.empty(3), np.empty(3))
    assert count == 0
    assert np.isnan(point).all()
