import cv2
import numpy as np
import pytest

from worldpose.cameras.distortion import distort
from worldpose.triangulation.reprojection import (
    deviations,
    inverse,
    linear_point,
    normal_equations,
    solve,
)

POINT = np.array([0.7, -1.1, 1.3])


@pytest.fixture
def views(ring):
    """Rows and poses of four views of `POINT`, each some pixels off."""
    camera = ring(4)
    image = camera.project(POINT[None]) + np.array([[3, 1], [-2, 4], [1, 1], [0, -3]])[:, None]
    rows = np.empty((4, 7))
    for row, (u, v), k, (fx, fy) in zip(
        rows, camera.normalize(image)[:, 0], camera.distortion, camera.focal, strict=True
    ):
        _, _, dxx, dxy, dyy = distort(u, v, *k)
        row[:] = u, v, fx * dxx, fx * dxy, fy * dxy, fy * dyy, 1.0
    rows[:, 6] = [1.0, 0.5, 0.8, 0.3]
    pose = camera.cam_from_world
    poses = np.concatenate([pose.rotation, pose.translation[..., None]], axis=-1).reshape(4, 12)
    return camera, image[:, 0], rows, poses


def test_deviations_are_cv2_pixel_errors_over_the_variance(views):
    camera, image, rows, poses = views
    out = np.empty(4)
    deviations(tuple(POINT), rows, poses, (2.0, 0.0), 4, out)
    for n in range(4):
        matrix = np.diag([*camera.focal[n], 1.0])
        matrix[:2, 2] = camera.principal_point[n]
        pose = camera.cam_from_world[n]
        rotation = cv2.Rodrigues(pose.rotation)[0]
        pixel, _ = cv2.projectPoints(
            POINT[None], rotation, pose.translation, matrix, camera.distortion[n]
        )
        squared = ((pixel.ravel() - image[n]) ** 2).sum()
        # The lens is linearised over 5 px: less than 1 % of a squared length.
        np.testing.assert_allclose(out[n], squared * rows[n, 6] / 4.0, rtol=0.01)


def test_metric_noise_adds_pixels_per_metre(views):
    camera, _, rows, poses = views
    pixels, both = np.empty(4), np.empty(4)
    deviations(tuple(POINT), rows, poses, (2.0, 0.0), 4, pixels)
    deviations(tuple(POINT), rows, poses, (2.0, 0.1), 4, both)
    depth = camera.cam_from_world.apply(POINT[None])[:, 0, 2]
    per_metre = np.sqrt(rows[:, 2] * rows[:, 5] - rows[:, 3] * rows[:, 4]) / depth
    np.testing.assert_allclose(pixels / both, 1 + (0.1 * per_metre / 2.0) ** 2, rtol=1e-12)


def test_point_behind_a_camera_deviates_infinitely(views):
    camera, _, rows, poses = views
    behind = camera.center[0] * 1.5
    out = np.empty(4)
    deviations(tuple(behind), rows, poses, (1.0, 0.0), 4, out)
    assert out[0] == np.inf


def test_normal_equations_are_the_derivatives_of_the_cost(views):
    _, _, rows, poses = views
    weights = np.array([1.0, 0.2, 0.0, 0.7])
    noise = (1.5, 0.0)

    def cost(point):
        out = np.empty(4)
        deviations(tuple(point), rows, poses, noise, 4, out)
        return (weights * out).sum()

    matrix, right, squares = normal_equations(tuple(POINT), rows, poses, weights, noise, 4)
    step = 1e-5
    slope = [(cost(POINT + d) - cost(POINT - d)) / (2 * step) for d in step * np.eye(3)]
    # Central differences of a cost of about 10 with 1e-16 relative rounding: 1e-10 absolute.
    np.testing.assert_allclose(right, -0.5 * np.array(slope), rtol=1e-6)
    a, b, c, d, e, f = matrix
    gauss_newton = np.array([[a, b, c], [b, d, e], [c, e, f]])
    bend = np.empty((3, 3))
    step = 1e-3
    for i, p in enumerate(step * np.eye(3)):
        for j, q in enumerate(step * np.eye(3)):
            bend[i, j] = (
                cost(POINT + p + q)
                - cost(POINT + p - q)
                - cost(POINT - p + q)
                + cost(POINT - p - q)
            ) / (4 * step**2)
    # The Hessian has a term of residual times curvature more: 5 px over 1500 px.
    np.testing.assert_allclose(gauss_newton, 0.5 * bend, atol=0.02 * np.trace(gauss_newton))
    assert squares == pytest.approx(_weighted_squares(rows, poses, weights))


def _weighted_squares(rows, poses, weights):
    even = rows.copy()
    even[:, 6] = 1.0
    out = np.empty(4)
    deviations(tuple(POINT), even, poses, (1.0, 0.0), 4, out)
    return (weights * out).sum()


def test_inverse_and_solution_of_a_hand_made_system():
    # diag(2, 4, 5) turned by nothing, and a full one checked by numpy.
    assert inverse((2.0, 0.0, 0.0, 4.0, 0.0, 5.0)) == (0.5, 0.0, 0.0, 0.25, 0.0, 0.2)
    full = np.array([[4.0, 1.0, -0.5], [1.0, 3.0, 0.2], [-0.5, 0.2, 2.0]])
    packed = tuple(full[np.triu_indices(3)])
    # Three by three, well conditioned: rounding only.
    np.testing.assert_allclose(inverse(packed), np.linalg.inv(full)[np.triu_indices(3)], rtol=1e-13)
    right = (1.0, -2.0, 0.5)
    np.testing.assert_allclose(solve(packed, right), np.linalg.solve(full, right), rtol=1e-13)


def test_singular_system_is_nan():
    assert np.isnan(inverse((1.0, 1.0, 0.0, 1.0, 0.0, 1.0))).all()
    assert np.isnan(solve((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0))).all()


def test_linear_point_leaves_out_views_without_weight(ring):
    camera = ring(4)
    rows = np.zeros((4, 7))
    rows[:, :2] = camera.normalize(camera.project(POINT[None]))[:, 0]
    rows[:, [2, 5, 6]] = 1500.0, 1520.0, 1.0
    rows[2, :2] += 0.3
    pose = camera.cam_from_world
    poses = np.concatenate([pose.rotation, pose.translation[..., None]], axis=-1).reshape(4, 12)
    weights = np.array([1.0, 1.0, 0.0, 1.0])
    # Exact views: what remains is the undistortion, 1e-13 of 30 m.
    np.testing.assert_allclose(linear_point(rows, poses, weights, 4), POINT, atol=1e-11)
