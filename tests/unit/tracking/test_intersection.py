import numpy as np
import pytest

from worldpose.tracking.intersection import intersect_people

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


def test_one_view_and_no_view_determine_nothing(ring, people):
    _, centers, directions, weights = scene(ring, people)
    index = np.array([0, -1, -1, -1, -1])[:, None]
    found = intersect_people(centers, directions, weights, index, unknown(), GATE, SINE)
    assert np.isnan(found).all()


def test_joint_without_weight_is_not_seen(ring, people):
    _, centers, directions, weights = scene(ring, people)
    weights[1:, :, 3] = 0.0
    index = np.zeros((5, 1), np.int64)
    found = intersect_people(centers, directions, weights, index, unknown(), GATE, SINE)
    assert np.isnan(found[0, 3]).all()
    assert np.isfinite(found[0, :3]).all()


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


def test_two_rays_that_pass_at_a_distance_determine_nothing(ring, people):
    _, centers, directions, weights = scene(ring, people)
    directions[1, 0, :, 2] += 0.1
    directions[1] /= np.linalg.norm(directions[1], axis=-1, keepdims=True)
    index = np.array([0, 0, -1, -1, -1])[:, None]
    found = intersect_people(centers, directions, weights, index, unknown(), GATE, SINE)
    assert np.isnan(found).all()


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
