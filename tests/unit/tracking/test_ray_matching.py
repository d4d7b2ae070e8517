import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldpose.tracking.ray_matching import (
    intersect_people,
    match_greedily,
    match_optimally,
    ray_affinity,
)

ORIGIN = np.zeros((1, 3))
ALONG_Y = np.array([0.0, 1.0, 0.0])


def rays(*directions):
    """One camera, one detection."""
    return np.array(directions, dtype=float)[None, None]


def affinity_of(joints, centers, directions, min_joints, gate=np.inf):
    """All joints seen weigh the same."""
    weights = np.where(np.isfinite(directions[..., 0]), 1.0, 0.0)
    gates = np.full((len(centers), len(joints)), gate)
    return ray_affinity(joints, centers, directions, weights, gates, min_joints)


def test_affinity_is_minus_the_mean_distance_to_the_rays():
    # 3 m beside the y axis, and 1 m above it: mean 2 m.
    joints = np.array([[[3.0, 4.0, 0.0], [0.0, 9.0, 1.0]]])
    affinity = affinity_of(joints, ORIGIN, rays(ALONG_Y, ALONG_Y), 1)
    assert affinity.shape == (1, 1, 1)
    np.testing.assert_allclose(affinity, -2.0, rtol=1e-15)


def test_joints_missing_on_either_side_are_left_out():
    nothing = np.full(3, np.nan)
    joints = np.array([[[3.0, 4.0, 0.0], [0.0, 9.0, 1.0], nothing]])
    affinity = affinity_of(joints, ORIGIN, rays(ALONG_Y, nothing, ALONG_Y), 1)
    np.testing.assert_allclose(affinity, -3.0, rtol=1e-15)


def test_best_pair_is_matched_first_and_each_detection_once():
    # Person 0 is 0.2 from detection 0 and 0.3 from 1; person 1 is 0.1 from 0 and 0.9 from 1.
    affinity = -np.array([[[0.2, 0.3], [0.1, 0.9]]])
    assert match_greedily(affinity).tolist() == [[1, 0]]


def test_least_sum_is_matched_where_people_compete():
    # 0 with 0 and 1 with 1 is 0.5 m; greed begins with 0.1 m and pays 0.8 m.
    affinity = -np.array([[[0.2, 0.7], [0.1, 0.3]]])
    assert match_optimally(affinity, -1.0).tolist() == [[0, 1]]
    assert match_greedily(affinity).tolist() == [[1, 0]]


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


GATE = 0.5
SINE = 0.1


def scene(ring, people, count=5):
    """Centres, directions and weights of one person's detection in every camera."""
    camera = ring(count)
    joints = people([1.0, -2.0])
    offsets = joints[None] - camera.center[:, None]
    directions = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    return joints, camera.center, directions[:, None], np.ones((count, 1, 17))


def unknown():
    return np.full((1, 17, 3), np.nan)


def test_exact_rays_meet_at_the_joints(ring, people):
    joints, centers, directions, weights = scene(ring, people)
    index = np.zeros((5, 1), np.int64)
    found = intersect_people(centers, directions, weights, index, unknown(), GATE, SINE)
    # Rounding of 30 m; seen 2e-14.
    np.testing.assert_allclose(found[0], joints, atol=1e-12)


def test_parallel_rays_determine_nothing(ring, people):
    joints, centers, directions, weights = scene(ring, people)
    centers = np.stack([centers[0], centers[0] + [0.0, 0.0, 0.1]])
    offsets = joints - centers[:, None]
    directions = (offsets / np.linalg.norm(offsets, axis=-1, keepdims=True))[:, None]
    index = np.zeros((2, 1), np.int64)
    found = intersect_people(centers, directions, weights[:2], index, unknown(), GATE, SINE)
    assert np.isnan(found).all()


def test_view_of_someone_else_has_little_say(ring, people):
    joints, centers, directions, weights = scene(ring, people)
    elsewhere = people([2.5, -2.0]) - centers[0]
    directions[0, 0] = elsewhere / np.linalg.norm(elsewhere, axis=-1, keepdims=True)
    index = np.zeros((5, 1), np.int64)
    found = intersect_people(centers, directions, weights, index, unknown(), GATE, SINE)
    # A plain mean of five views would be off by some 30 cm; the last of the few reweightings
    # leaves a per cent of that; seen 6 mm.
    assert np.linalg.norm(found[0] - joints, axis=-1).max() < 0.01


def test_expected_place_settles_which_of_two_pairs_counts(ring, people):
    joints, centers, directions, weights = scene(ring, people, 4)
    other = people([4.0, 1.0])
    for c in (2, 3):
        offsets = other - centers[c]
        directions[c, 0] = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    index = np.zeros((4, 1), np.int64)
    for truth in (joints, other):
        near = truth[None] + 0.1
        found = intersect_people(centers, directions, weights, index, near, GATE, SINE)
        # The other pair passes metres away and keeps under (1 / 100)^2 of the weight.
        assert np.linalg.norm(found[0] - truth, axis=-1).max() < 0.01


@pytest.mark.parametrize(
    ("weights", "place"),
    # At half the distance a ray counts four times as much, and as its weight says.
    [((1.0, 1.0), 0.002), ((1.0, 4.0), 0.005), ((4.0, 1.0), 0.01 / 17.0)],
)
def test_rays_count_by_their_weight_over_their_squared_length(weights, place):
    # Two that are parallel, 10 and 20 m long and 1 cm apart, and one that crosses both.
    centers = np.array([[0.0, -10.0, 0.0], [0.01, 20.0, 0.0], [-15.0, 0.0, 0.0]])
    directions = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])[:, None, None]
    index, near = np.zeros((3, 1), np.int64), np.full((1, 1, 3), np.nan)
    each = np.array([*weights, 1.0])[:, None, None]
    found = intersect_people(centers, directions, each, index, near, GATE, SINE)
    # The loss takes 2 (1 / 25)^2 from what is 1 cm off.
    np.testing.assert_allclose(found[0, 0], [place, 0.0, 0.0], atol=2e-5)
