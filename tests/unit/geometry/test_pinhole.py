import numpy as np
import pytest
from pydantic import ValidationError

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rays import RayStatus
from worldpose.geometry.rigid import Rigid


def simple_camera(**changes) -> Camera:
    """A camera at the world's origin with its axes along the world's."""
    fields = {
        "focal": np.array([1000.0, 1000.0]),
        "principal_point": np.array([960.0, 540.0]),
        "distortion": np.zeros(5),
        "cam_from_world": Rigid.identity(),
        "image_size": np.array([1920, 1080]),
    }
    return Camera(**{**fields, **changes})


def test_main_camera_sees_the_pitch_upright():
    # At negative y, looking along +y: camera x = world x, camera y = -z, camera z = y.
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    camera = simple_camera(cam_from_world=Rigid(rotation, [0.0, 0.0, 50.0]))
    np.testing.assert_allclose(camera.center, [0.0, -50.0, 0.0], atol=1e-12)
    right, high = camera.project([[5.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    np.testing.assert_allclose(right, [1060.0, 540.0], atol=1e-12)
    np.testing.assert_allclose(high, [960.0, 440.0], atol=1e-12)


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
        (
            lambda: simple_camera(focal=np.ones((2, 2)), distortion=np.zeros((3, 5))),
            "broadcast",
            r"\(3,\)",
        ),
        (lambda: simple_camera().project(np.zeros(3)), r"\(\.\.\., n, 3\)", r"\(3,\)"),
        (lambda: simple_camera().unproject(np.zeros((4, 3))), r"\(\.\.\., n, 2\)", r"\(4, 3\)"),
        (
            lambda: simple_camera(focal=np.ones((2, 2))).project(np.zeros((3, 4, 3))),
            "broadcast",
            r"\(2,\) and \(3,\)",
        ),
        (lambda: Camera.stack([]), "one or more", r"\[\]"),
        (
            lambda: Camera.stack([simple_camera(), simple_camera(focal=np.ones((2, 2)))]),
            "one batch shape",
            r"\[\(\), \(2,\)\]",
        ),
        (
            lambda: simple_camera(focal=np.ones((2, 2))).to_calibration("c"),
            "a single camera",
            r"\(2,\)",
        ),
    ],
)
def test_wrong_shapes_are_refused_with_both_shapes(make, expected, found):
    with pytest.raises(InputError, match=expected + ".*" + found):
        make()


def calibration(**changes) -> CameraCalibration:
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
