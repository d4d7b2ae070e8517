"""The lens models behind one interface, against OpenCV and finite differences."""

import cv2
import numpy as np
import pytest

from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import (
    CameraNumbers,
    LensModel,
    by_coefficients,
    distort,
    fold_squared,
    lens_rows,
    undistort,
)
from worldpose.geometry.rays import RayStatus
from worldpose.geometry.rigid import Rigid

# k1 k2 p1 p2 k3 k4 k5 k6, as calibrations of wide lenses have them.
RATIONAL = np.array([0.4, -0.05, 1e-3, -2e-3, 0.01, 0.7, 0.02, 0.003])
FISHEYE = np.array([0.02, -0.01, 0.0, 0.0, 0.004, -0.001, 0.0, 0.0])
MATRIX = np.array([[900.0, 0.0, 970.0], [0.0, 880.0, 530.0], [0.0, 0.0, 1.0]])
POSE = Rigid.from_rotvec([0.1, -0.2, 0.05], [0.3, -0.2, 4.0])


def camera(model, distortion):
    return Camera(
        focal=np.diag(MATRIX)[:2],
        principal_point=MATRIX[:2, 2],
        distortion=distortion,
        cam_from_world=POSE,
        image_size=np.array([1920, 1080]),
        lens_model=model,
    )


def numbers(distortion, model):
    return CameraNumbers(*lens_rows(distortion, model))


def opencv(model, distortion, points):
    pose = POSE.rotvec, np.array(POSE.translation)
    if model == LensModel.FISHEYE:
        four = distortion[[0, 1, 4, 5]]
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], *pose, MATRIX, four)
    else:
        pixels, _ = cv2.projectPoints(points, *pose, MATRIX, distortion)
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize(
    ("model", "distortion"), [(LensModel.RATIONAL, RATIONAL), (LensModel.FISHEYE, FISHEYE)]
)
class TestModel:
    def test_pixels_are_opencvs_and_return(self, model, distortion):
        points = np.random.default_rng(0).uniform([-4, -3, -1], [4, 3, 3], (200, 3))
        made = camera(model, distortion)
        pixels = made.project(points)
        assert np.isfinite(pixels).all()
        np.testing.assert_allclose(pixels, opencv(model, distortion, points), atol=1e-9)
        rays = made.unproject(pixels)
        assert (rays.status == RayStatus.OK).all()
        away = points - made.center
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        np.testing.assert_allclose(rays.directions, away, atol=1e-12)

    def test_derivatives_equal_finite_differences(self, model, distortion):
        points = np.array([[0.4, -0.7, 0.3], [-2.0, 1.5, 1.0], [0.0, 0.0, 0.0]])
        made = camera(model, distortion)
        found = made.project_with_jacobians(points)
        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            numeric = (made.project(points + step) - made.project(points - step)) / 2e-6
            np.testing.assert_allclose(found.d_points[..., axis], numeric, atol=1e-5)
        for k in range(6):
            step = 1e-6 * np.eye(6)[k]
            numeric = (
                made_pose(made, step).project(points) - made_pose(made, -step).project(points)
            ) / 2e-6
            np.testing.assert_allclose(found.d_pose[..., k], numeric, atol=1e-5)

    def test_the_derivatives_by_coefficients_equal_finite_differences(self, model, distortion):
        x, y = 0.6, -0.3
        slopes = np.array(by_coefficients(numbers(distortion, model), x * x + y * y))
        for place, slope in zip((0, 1, 4, 5, 6, 7), slopes, strict=True):
            change = 1e-6 * np.eye(8)[place]
            ahead, behind = (
                np.array(distort(numbers(distortion + way, model), x, y)[:2])
                for way in (change, -change)
            )
            numeric = (ahead - behind) / 2e-6
            if model == LensModel.FISHEYE and place > 5:
                assert slope == 0.0
            else:
                np.testing.assert_allclose(slope * np.array([x, y]), numeric, atol=1e-9)

    def test_undistortion_ends_at_the_fold(self, model, distortion):
        # A strong third term folds the image back.
        folded = distortion + np.array([0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
        lens = numbers(folded, model)
        radius = np.sqrt(fold_squared(lens))
        assert radius == lens.fold < 3.0
        before, fold, after = (distort(lens, r * radius, 0.0)[0] for r in (0.99, 1.0, 1.01))
        assert before < fold > after
        straight = folded.copy()
        straight[2:4] = 0.0
        lens = numbers(straight, model)
        limit = distort(lens, lens.fold, 0.0)[0]
        assert undistort(lens, 0.999 * limit, 0.0)[2] == RayStatus.OK
        assert undistort(lens, 1.001 * limit, 0.0)[2] == RayStatus.BEYOND_FOLD


def made_pose(made, step):
    return Camera(
        made.focal,
        made.principal_point,
        made.distortion,
        made.cam_from_world.retract(step),
        made.image_size,
        made.lens_model,
    )
