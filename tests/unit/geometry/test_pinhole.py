"""Projection through lenses and its inverse: pixels, derivatives and rays by OpenCV and by hand."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel, fold_radius
from worldpose.geometry.rays import Rays, RayStatus, intersect_rays
from worldpose.geometry.rigid import Rigid


def simple_camera(**changes):
    """A camera at the world's origin with its axes along the world's."""
    fields = {
        "focal": np.array([1000.0, 1000.0]),
        "principal_point": np.array([960.0, 540.0]),
        "distortion": np.zeros(5),
        "cam_from_world": Rigid.identity(),
        "image_size": np.array([1920, 1080]),
    }
    return Camera(**{**fields, **changes})


def two_cameras(**changes):
    return simple_camera(focal=np.ones((2, 2)), **changes)


def test_point_behind_the_camera_or_in_its_plane_has_no_image():
    points = [[0.0, 0.0, -5.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    found = simple_camera().project_with_jacobians(points)
    assert found.status.tolist() == [RayStatus.BEHIND] * 3 + [RayStatus.OK]
    assert np.isnan(found.points_image[:3]).all()
    assert np.isnan(simple_camera().project(points)[:3]).all()
    for jacobian in (found.d_points, found.d_pose, found.d_intrinsics, found.d_distortion):
        assert np.isnan(jacobian[:3]).all()
        assert np.isfinite(jacobian[3]).all()


def test_batches_of_cameras_give_what_single_cameras_give():
    rng = np.random.default_rng(0)
    singles = [
        simple_camera(
            focal=rng.uniform(900.0, 1100.0, 2),
            distortion=rng.uniform(-0.1, 0.1, 5) * [1, 1, 0.01, 0.01, 1],
            cam_from_world=Rigid.from_rotvec(rng.normal(0.0, 0.1, 3), [0.0, 0.0, 20.0]),
        )
        for _ in range(4)
    ]
    batch = Camera.stack(singles)
    points = rng.uniform(-5.0, 5.0, (3, 1, 6, 3))
    image = batch.project(points)
    jacobians = batch.project_with_jacobians(points)
    rays = batch.unproject(image)
    plane = batch.normalize(image)
    assert image.shape == (3, 4, 6, 2)
    assert rays.directions.shape == rays.origins.shape == (3, 4, 6, 3)
    assert batch.center.shape == (4, 3)
    for frame in range(3):
        for index, camera in enumerate(singles):
            alone = camera.project_with_jacobians(points[frame, 0])
            for name in ("points_image", "d_points", "d_pose", "d_intrinsics", "d_distortion"):
                np.testing.assert_array_equal(
                    getattr(jacobians, name)[frame, index], getattr(alone, name)
                )
            np.testing.assert_array_equal(image[frame, index], alone.points_image)
            ray = camera.unproject(alone.points_image)
            np.testing.assert_array_equal(rays[frame, index].directions, ray.directions)
            np.testing.assert_array_equal(rays[frame, index].origins, ray.origins)
            np.testing.assert_array_equal(plane[frame, index], camera.normalize(alone.points_image))


def test_no_points_and_no_cameras_are_fine():
    assert simple_camera().project(np.empty((0, 3))).shape == (0, 2)
    empty = simple_camera(focal=np.empty((0, 2)))
    assert empty.project(np.zeros((5, 3))).shape == (0, 5, 2)
    assert empty.unproject(np.zeros((5, 2))).directions.shape == (0, 5, 3)
    assert empty.project_with_jacobians(np.zeros((5, 3))).d_pose.shape == (0, 5, 2, 6)


@pytest.mark.parametrize(
    ("make", "expected", "found"),
    [
        (lambda: simple_camera(focal=1000.0), r"\(\.\.\., 2\)", r"\(\)"),
        (lambda: simple_camera(distortion=np.zeros(4)), r"\(\.\.\., 8\)", r"\(4,\)"),
        (lambda: two_cameras(distortion=np.zeros((3, 5))), "broadcast", r"\(3,\)"),
        (lambda: simple_camera().project(np.zeros(3)), r"\(\.\.\., n, 3\)", r"\(3,\)"),
        (lambda: simple_camera().unproject(np.zeros((4, 3))), r"\(\.\.\., n, 2\)", r"\(4, 3\)"),
        (lambda: two_cameras().project(np.zeros((3, 4, 3))), "broadcast", r"\(2,\) and \(3,\)"),
        (lambda: Camera.stack([]), "one or more", r"\[\]"),
        (lambda: Camera.stack([simple_camera(), two_cameras()]), "one batch", r"\[\(\), \(2,\)\]"),
        (lambda: two_cameras().to_calibration("c"), "a single camera", r"\(2,\)"),
    ],
)
def test_wrong_shapes_are_refused_with_both_shapes(make, expected, found):
    with pytest.raises(InputError, match=expected + ".*" + found):
        make()


def calibration(**changes):
    rotation = Rigid.from_rotvec([2.0, -0.3, 0.4], np.zeros(3)).rotation
    fields = {
        "id": "north",
        "image_size": (1920, 1080),
        "focal_px": (3000.0, 3001.0),
        "principal_point_px": (950.0, 530.0),
        "distortion": (0.1, -0.2, 0.001, 0.002, 0.3),
        "rotation": rotation.tolist(),
        "translation": (1.0, 2.0, 90.0),
    }
    return CameraCalibration(**{**fields, **changes})


def test_calibration_record_comes_back_bit_for_bit():
    assert Camera.from_calibration(calibration()).to_calibration("north") == calibration()


@pytest.mark.parametrize("digits", [6, 7, 9])
def test_rotation_from_a_text_file_becomes_exact(digits):
    exact = Rigid.from_rotvec([2.0, -0.3, 0.4], np.zeros(3)).rotation
    rounded = calibration(rotation=np.round(exact, digits).tolist())
    found = Camera.from_calibration(rounded).cam_from_world.rotation
    np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-15)
    # Each of the entries was moved by at most half a unit of the last digit.
    np.testing.assert_allclose(found, exact, atol=1.5 * 10.0**-digits)


@pytest.mark.parametrize(
    ("rotation", "found"),
    [
        (np.diag([1.0, 1.0, -1.0]), "determinant -1"),  # mirrored
        (np.diag([1.001, 1.0, 1.0]), "largest entry 0.002"),
        (np.zeros((3, 3)), "determinant 0"),
        (np.round(Rigid.from_rotvec([2.0, -0.3, 0.4], np.zeros(3)).rotation, 3), "R\\^T R"),
    ],
)
def test_matrix_that_is_no_rotation_is_refused(rotation, found):
    with pytest.raises(InputError, match="camera north: rotation: .*" + found):
        Camera.from_calibration(calibration(rotation=rotation.tolist()))


@pytest.mark.parametrize(
    ("matrix", "rotation", "where"),
    [
        (np.diag([1000.0, 1000.0, 1.0]) + np.eye(3, k=1), np.eye(3), "matrix"),
        (np.diag([1000.0, 1000.0, 1.0]), np.diag([1.0, 1.0, -1.0]), "rotation"),
        (np.diag([1000.0, 1000.0, 1.0]), 1.01 * np.eye(3), "rotation"),
        (np.diag([1000.0, -1000.0, 1.0]), np.eye(3), "expected positive focal lengths"),
    ],
)
def test_matrices_that_no_camera_has_are_refused(matrix, rotation, where):
    with pytest.raises(InputError, match=f"from_matrices: {where}"):
        Camera.from_matrices(matrix, np.zeros(5), rotation, np.zeros(3), (1920, 1080))


@pytest.mark.parametrize(
    "change", [{"focal_px": (0.0, 3000.0)}, {"focal_px": (3000.0, -1.0)}, {"image_size": (0, 5)}]
)
def test_senseless_calibration_is_refused(change):
    with pytest.raises(ValidationError, match="greater than 0"):
        calibration(**change)


@st.composite
def stadium_cameras(draw, tangential=True):
    """Cameras 40 to 120 m from the pitch, with the lenses of real broadcast cameras and wider."""
    focal = draw(st.floats(2400.0, 7100.0))
    spread = st.floats(-1.0, 1.0)
    p1, p2 = (0.002 * draw(spread), 0.002 * draw(spread)) if tangential else (0.0, 0.0)
    return Camera(
        focal=np.array([focal, focal * (1.0 + 0.01 * draw(spread))]),
        principal_point=np.array([960.0 + 30.0 * draw(spread), 540.0 + 30.0 * draw(spread)]),
        distortion=np.array(
            [draw(st.floats(-0.3, 0.99)), draw(st.floats(-1.06, 4.29)), p1, p2, 0.5 * draw(spread)]
        ),
        cam_from_world=Rigid.from_rotvec(
            [draw(spread), draw(spread), draw(spread)], [0.0, 0.0, draw(st.floats(40.0, 120.0))]
        ),
        image_size=np.array([1920, 1080]),
    )


def points_in_view(camera, seed, count=20):
    """World points that a camera without distortion sees inside the image, 30 to 150 m deep."""
    rng = np.random.default_rng(seed)
    size = camera.image_size.astype(float)
    pixels = rng.uniform(-0.5, size - 0.5, (count, 2))
    depth = rng.uniform(30.0, 150.0, (count, 1))
    plane = (pixels - camera.principal_point) / camera.focal
    points_cam = depth * np.concatenate([plane, np.ones((count, 1))], axis=1)
    return camera.cam_from_world.inverse().apply(points_cam)


def opencv(camera, points):
    matrix = np.diag([*camera.focal, 1.0])
    matrix[:2, 2] = camera.principal_point
    image, jacobian = cv2.projectPoints(
        points,
        camera.cam_from_world.rotvec,
        np.array(camera.cam_from_world.translation),
        matrix,
        np.array(camera.coefficients),
    )
    return image.reshape(-1, 2), jacobian.reshape(-1, 2, jacobian.shape[-1])


@given(stadium_cameras(), st.integers(0, 99))
def test_projection_equals_opencv(camera, seed):
    points = points_in_view(camera, seed)
    found = camera.project_with_jacobians(points)
    seen = found.status == RayStatus.OK
    expected, jacobian = opencv(camera, points)
    # Rounding of 5000 px, and of the rotation vector at 150 m and 7100 px: 1e-15 * 7100 * few.
    np.testing.assert_allclose(found.points_image[seen], expected[seen], atol=1e-9)
    np.testing.assert_array_equal(camera.project(points), found.points_image)
    # OpenCV's columns: rotation vector, translation, fx fy cx cy, k1 k2 p1 p2 k3. Derivatives by
    # the rotation vector follow another rule and are compared with differences below.
    np.testing.assert_allclose(found.d_pose[seen][..., 3:], jacobian[seen][..., 3:6], rtol=1e-9,
                               atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(found.d_intrinsics[seen], jacobian[seen][..., 6:10], atol=1e-12)
    np.testing.assert_allclose(
        found.d_distortion[seen][..., :5], jacobian[seen][..., 10:], atol=1e-9
    )


def central_differences(function, size, step):
    """Derivatives by `size` parameters around zero, of order step^4, as the last dimension."""

    def difference(k, h):
        delta = np.zeros(size)
        delta[k] = h
        return (function(delta) - function(-delta)) / (2.0 * h)

    return np.stack(
        [(4.0 * difference(k, step / 2) - difference(k, step)) / 3.0 for k in range(size)], axis=-1
    )


@settings(max_examples=50)
@given(stadium_cameras(), st.integers(0, 99))
def test_jacobians_equal_finite_differences(camera, seed):
    # Away from the fold, where second derivatives stay small.
    points = 0.5 * points_in_view(camera, seed, 8) + 0.5 * camera.center
    points = points[np.isfinite(camera.project(points)).all(axis=-1)]
    plane = camera.cam_from_world.apply(points)
    radius = np.linalg.norm(plane[:, :2] / plane[:, 2:], axis=-1)
    points = points[radius < 0.9 * fold_radius(camera.coefficients)]
    found = camera.project_with_jacobians(points)

    def turned(step):
        pose = camera.cam_from_world.retract(step)
        return replace(camera, cam_from_world=pose).project(points)

    # Derivatives by the intrinsics and the lens are OpenCV's, see above.
    cases = [
        (found.d_points, lambda d: camera.project(points + d), 3, 1e-2),
        (found.d_pose, turned, 6, 1e-4),
    ]
    for jacobian, function, size, step in cases:
        expected = central_differences(function, size, step)
        # Rounding of 1e-12 px over the step; the rest is below for these steps.
        scale = 1.0 + np.abs(expected)
        assert np.all(np.abs(jacobian - expected) <= 1e-6 * scale)


@given(stadium_cameras(), st.integers(0, 99))
def test_pixel_to_ray_to_pixel_returns(camera, seed):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(-0.5, [1919.5, 1079.5], (50, 2))
    rays = camera.unproject(pixels)
    points = rays.origins + rays.directions * rng.uniform(1.0, 200.0, (50, 1))
    # Rounding of points 200 m away, 3e-14 m, seen with 7100 px from 1 m: 2e-10 px.
    np.testing.assert_allclose(camera.project(points)[rays.valid], pixels[rays.valid], atol=1e-9)
    assert np.isnan(rays.directions[~rays.valid]).all()
    assert np.isin(rays.status, [RayStatus.OK, RayStatus.BEYOND_FOLD]).all()


def rays_through(origins, targets, missing=()):
    origins, targets = np.broadcast_arrays(np.asarray(origins, float), np.asarray(targets, float))
    offset = targets - origins
    directions = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    status = np.zeros(directions.shape[:-1], np.uint8)
    for place in missing:
        directions[place], status[place] = np.nan, RayStatus.BEYOND_FOLD
    return Rays(origins, directions, status)


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
        [2] if weights is None else (),
    )
    point, normal = intersect_rays(rays, weights)
    np.testing.assert_allclose(point, np.zeros(3), atol=1e-14)
    np.testing.assert_allclose(normal, np.diag([1.0, 1.0, 2.0]), atol=1e-14)


def test_fewer_than_two_rays_determine_no_point():
    origins, targets = np.random.default_rng(3).uniform(-50.0, 50.0, (2, 3, 2, 3))
    points, _ = intersect_rays(rays_through(origins, targets, [0, (1, 1)]))
    assert np.isnan(points).all(axis=-1).tolist() == [True, True, False]
    assert np.isnan(intersect_rays(rays_through(origins[:, :0], targets[:, :0]))[0]).all()


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


@pytest.mark.parametrize(
    ("lens", "size", "model", "words"),
    [
        (5, None, LensModel.BROWN, "image_size: expected shape"),
        (5, (1920.5, 1080), LensModel.BROWN, "a positive, whole image size"),
        (5, (1920, 1080), "fisheye", "expected a LensModel, found 'fisheye'"),
        (8, (1920, 1080), LensModel.BROWN, "distortion of lens_model brown: expected shape"),
    ],
)
def test_sizes_and_lens_models_that_no_camera_has_are_refused(lens, size, model, words):
    with pytest.raises(InputError, match=words):
        Camera.from_matrices(np.eye(3), np.zeros(lens), np.eye(3), np.zeros(3), size, model)
