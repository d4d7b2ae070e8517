import numpy as np

from worldpose.tracking.epipolar import associate, footprints, pair_distances
from worldpose.tracking.settings import TrackingSettings

SETTINGS = TrackingSettings(pair_evidence=0.0)
ANYWHERE = np.array([[0.0, 0.0, np.inf]] * 2)
TWO = np.array([0, 1])


def rays_of(camera, joints, noise=0.0):
    """Directions and weights (cameras, persons, 17) of people (persons, 17, 3)."""
    offsets = joints[None] - camera.center[:, None, None]
    directions = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    directions += np.random.default_rng(3).normal(0, noise, directions.shape)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return directions, np.ones(directions.shape[:-1])


def test_crossing_rays_are_as_far_apart_as_their_common_perpendicular():
    # Along x at height 0 and along y at height 2.
    centers = np.array([[-5.0, 0.0, 0.0], [0.0, -5.0, 2.0]])
    directions = np.array([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]])
    distances = pair_distances(centers, directions, TWO, ANYWHERE, 1, 0.1, 9.0)
    np.testing.assert_allclose(distances, [[np.inf, 2.0], [np.inf, np.inf]], rtol=1e-15)


def test_parallel_rays_start_nothing():
    centers = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    directions = np.array([[[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]])
    assert np.isinf(pair_distances(centers, directions, TWO, ANYWHERE, 1, 0.1, 9.0)).all()


def test_people_are_found_with_all_their_detections(ring, people):
    camera = ring(6)
    joints = people([[0.0, 0.0], [0.8, 0.3], [-3.0, 2.0], [5.0, -4.0]])
    # 1 mrad is 1.5 px.
    groups = associate(camera.center, *rays_of(camera, joints, 1e-3), False, SETTINGS)
    assert sorted(tuple(group.index) for group in groups) == [(n,) * 6 for n in range(4)]
    for group in groups:
        truth = joints[group.index[0]]
        # 1 mrad at 30 m is 3 cm a view; six views, the worst of 204 coordinates.
        np.testing.assert_allclose(group.joints, truth, atol=0.06)
        assert group.ray_distance.max() < 0.06


def test_footprint_is_where_the_ray_is_at_the_height_of_a_body():
    # From 10 m up, 45 degrees down: at 1 m after 9 m, and 0.5 m to either side for 0.5 m of height.
    down = np.array([[[0.0, 1.0, -1.0]]]) / np.sqrt(2.0)
    place = footprints(np.array([[2.0, 3.0, 10.0]]), down, (1.0, 0.5))
    np.testing.assert_allclose(place, [[2.0, 12.0, 0.5]], rtol=1e-14)


def test_people_far_apart_on_the_ground_are_no_pair_even_where_rays_meet():
    centers = np.array([[-5.0, 0.0, 5.0], [0.0, -5.0, 5.0]])
    directions = np.array([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]])
    apart = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0]])
    gate = 1.0
    assert np.isinf(pair_distances(centers, directions, TWO, apart, 1, 0.1, gate)).all()
    apart[1, 0] = 2.9
    assert pair_distances(centers, directions, TWO, apart, 1, 0.1, gate)[0, 1] == 0.0
