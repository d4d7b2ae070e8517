import numpy as np
import pytest

from worldpose.geometry.rays import Rays, RayStatus, intersect_rays


def rays_through(origins, targets) -> Rays:
    origins, targets = np.broadcast_arrays(np.asarray(origins, float), np.asarray(targets, float))
    offset = targets - origins
    directions = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    return Rays(origins, directions, np.zeros(directions.shape[:-1], np.uint8))


def without(rays: Rays, *index) -> Rays:
    directions, status = rays.directions.copy(), rays.status.copy()
    directions[index], status[index] = np.nan, RayStatus.BEYOND_FOLD
    return Rays(rays.origins, directions, status)


def random_rays(rng: np.random.Generator, *shape: int) -> Rays:
    return rays_through(rng.uniform(-50, 50, (*shape, 3)), rng.uniform(-50, 50, (*shape, 3)))


def test_two_skew_rays_meet_halfway_and_weights_pull():
    rays = rays_through([[-5.0, 0.0, 0.0], [0.0, -5.0, 4.0]], [[5.0, 0.0, 0.0], [0.0, 5.0, 4.0]])
    np.testing.assert_allclose(intersect_rays(rays)[0], [0.0, 0.0, 2.0], atol=1e-14)
    # Weights 3 to 1 on squared distances: a quarter of the way.
    np.testing.assert_allclose(intersect_rays(rays, [3.0, 1.0])[0], [0.0, 0.0, 1.0], atol=1e-14)


@pytest.mark.parametrize("weights", [None, [1.0, 1.0, 0.0], [1.0, 1.0, np.nan]])
def test_missing_and_weightless_rays_are_left_out(weights):
    rays = rays_through(
        [[-5.0, 0.0, 0.0], [0.0, -5.0, 0.0], [9.0, 9.0, 9.0]],
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 2.0, 3.0]],
    )
    rays = without(rays, 2) if weights is None else rays
    point, normal = intersect_rays(rays, weights)
    np.testing.assert_allclose(point, np.zeros(3), atol=1e-14)
    np.testing.assert_allclose(normal, np.diag([1.0, 1.0, 2.0]), atol=1e-14)


def test_fewer_than_two_rays_determine_no_point():
    rays = random_rays(np.random.default_rng(3), 3, 2)
    rays = without(without(rays, 0), 1, 1)
    points, _ = intersect_rays(rays)
    assert np.isnan(points).all(axis=-1).tolist() == [True, True, False]
    assert np.isnan(intersect_rays(random_rays(np.random.default_rng(3), 1, 0))[0]).all()


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-7])
def test_parallel_rays_determine_no_point(turn):
    origins = [[0.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 3.0]]
    targets = [[10.0, 10.0 * turn, 0.0], [10.0, 5.0, 0.0], [10.0, 0.0, 3.0]]
    assert np.isnan(intersect_rays(rays_through(origins, targets))[0]).all()


def test_large_world_coordinates_keep_their_digits():
    shift = np.array([500_000.0, 4_000_000.0, 100.0])  # a survey grid
    origins = shift + np.array([[0.0, -5.0, 0.0], [0.0, 5.0, 0.0]])
    target = shift + np.array([1000.0, 0.0, 0.0])
    # As ten metres apart without the shift; solving in grid coordinates would lose 1e-5 m.
    np.testing.assert_allclose(intersect_rays(rays_through(origins, target))[0], target, rtol=0.0,
                               atol=1e-8)  # fmt: skip
