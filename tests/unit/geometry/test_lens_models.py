"""Models of lenses against OpenCV, and the limits of distortion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from camera_builders import plain_camera
from run_records import calibration

from data_contracts.cameras import COEFFICIENTS
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_fit import fit_brown_lens
from worldpose.geometry.lens_models import (
    CameraNumbers,
    LensModel,
    by_coefficients,
    distort,
    fold_radius,
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
            ahead, behind = (
                replace(made, cam_from_world=made.cam_from_world.retract(by * np.eye(6)[k]))
                for by in (1e-6, -1e-6)
            )
            numeric = (ahead.project(points) - behind.project(points)) / 2e-6
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


def plane_camera(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """A camera whose pixels are the distorted coordinates on the plane z = 1."""
    return plain_camera(1.0, (0.0, 0.0), Rigid.identity(), (2, 2), lens=(k1, k2, p1, p2, k3))


def on_plane(points):
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


@pytest.mark.parametrize(
    ("k1", "k2", "k3", "squared"),
    [
        (0.0, 0.0, 0.0, np.inf),
        (0.3, 0.2, 0.1, np.inf),
        (-1 / 3, 0.0, 0.0, 1.0),  # 1 - s
        (0.0, -1 / 5, 0.0, 1.0),  # 1 - s^2
        (0.0, 0.0, -1 / 7, 1.0),  # 1 - s^3
        (-2.5 / 3, 1 / 5, 0.0, 0.5),  # (1 - 2 s)(1 - s / 2)
        (-3 / 3, 2.75 / 5, -0.75 / 7, 2 / 3),  # (1 - 3 s / 2)(1 - s / 2)(1 - s)
        (2 / 3, -3 / 5, 0.0, 1.0),  # (1 - s)(1 + 3 s): rises first
        (-1.0 / 3, 1.0 / 5, 0.0, np.inf),  # 1 - s + s^2 > 0 everywhere
        (-1.0, 5.0, 0.0, np.inf),  # barrel near the centre, never folding
        (-1.0 / 3, 1.0 / 5, -1.0 / 7, 1.0),  # (1 - s)(1 + s^2)
        (0.0, -1e-12 / 5, 0.0, 1e6),  # 1 - 1e-12 s^2
        (-0.5, 3e-306, 0.0, 2 / 3),  # a term that is nothing beside the others
    ],
)
def test_fold_is_the_first_zero_of_the_slope(k1, k2, k3, squared):
    # A root of a polynomial with rounded coefficients: well conditioned in all these cases.
    np.testing.assert_allclose(fold_radius([k1, k2, 0.0, 0.0, k3]), np.sqrt(squared), rtol=1e-12)


def test_points_beyond_the_fold_have_no_image_and_pixels_beyond_it_no_ray():
    camera = plane_camera(k1=-1 / 3)  # folds at 1, where the image radius is 2 / 3
    points = on_plane([[0.999, 0.0], [1.001, 0.0], [0.0, 1.5], [-5.0, 0.0]])
    found = camera.project_with_jacobians(points)
    assert found.status.tolist() == [RayStatus.OK] + 3 * [RayStatus.BEYOND_FOLD]
    assert np.isfinite(camera.project(points)).all(axis=-1).tolist() == [True, False, False, False]
    rays = camera.unproject([[0.666, 0.0], [0.0, 0.667], [3.0, 4.0]])
    assert rays.status.tolist() == [RayStatus.OK] + 2 * [RayStatus.BEYOND_FOLD]
    assert np.isnan(rays.directions[1:]).all()


@pytest.mark.parametrize("k", [(-0.4, 0.0, 0.0), (-0.3, 0.1, -0.05), (0.2, -1.0, 0.0)])
def test_inverse_holds_up_to_the_brink_of_the_fold(k):
    k1, k2, k3 = k
    camera = plane_camera(k1=k1, k2=k2, k3=k3)
    fold = float(fold_radius([k1, k2, 0.0, 0.0, k3]))
    # At 1e-7 before the fold the image is 1e-14 short of its limit; at 1e-8 that is rounding.
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = (fold * (1.0 - np.logspace(-1, -7, 7)))[:, None, None] * spokes
    image = camera.project(on_plane(points.reshape(-1, 2)))
    rays = camera.unproject(image)
    assert rays.valid.all()
    back = camera.project(rays.directions)
    # The image returns to rounding even where the point itself is ill determined.
    np.testing.assert_allclose(back, image, atol=1e-15)


def test_missing_pixels_and_cameras_are_missing():
    rays = plane_camera(k1=0.1).unproject([[np.nan, 0.0], [0.0, np.inf], [0.0, 0.0]])
    assert rays.status.tolist() == [RayStatus.MISSING, RayStatus.MISSING, RayStatus.OK]
    absent = plane_camera(k1=np.nan)
    assert absent.unproject([[0.0, 0.0]]).status.tolist() == [RayStatus.MISSING]
    assert absent.project_with_jacobians([[0.0, 0.0, 1.0]]).status.tolist() == [RayStatus.MISSING]
    assert np.isnan(absent.project([[0.0, 0.0, 1.0]])).all()


def test_records_refuse_coefficients_of_another_model():
    for model, names in COEFFICIENTS.items():
        with pytest.raises(ValueError, match="found 3 numbers"):
            calibration("a", lens_model=model, distortion=(0.0,) * 3)
        assert calibration("a", lens_model=model, distortion=(0.0,) * len(names))


@pytest.mark.parametrize(
    ("model", "lens"), [("fisheye", (-0.05, 0.01, -0.002, 0.0005)), ("rational", tuple(RATIONAL))]
)
def test_browns_nearest_lens_states_its_largest_error(model, lens):
    stated = {"focal_px": (700.0, 700.0), "principal_point_px": (319.5, 239.5)}
    stated |= {"image_size": (640, 480), "lens_model": model, "distortion": lens}
    camera = Camera.from_calibration(calibration("a", **stated))
    near, told = fit_brown_lens(camera)
    error = told["max_error_px"]
    assert told["max_error_beyond_px"] == 0.0  # of no pixel: the fit is to the whole image
    rng = np.random.default_rng(0)
    rays = camera.unproject(rng.uniform([0, 0], [639, 479], (500, 2)))
    points = rays.origins + 5.0 * rays.directions
    off = np.linalg.norm(near.project(points) - camera.project(points), axis=1)
    assert 0.2 * error < off.max() <= 1.01 * error < 0.1


@pytest.mark.parametrize(("scale", "error"), [(1, 4.8), (2, 9.6)])
def test_browns_lens_of_an_ordinary_fisheye_holds_in_the_corners(scale, error):
    stated = {"focal_px": (1100.0 * scale,) * 2, "image_size": (1920 * scale, 1080 * scale)}
    stated |= {"principal_point_px": (960.0 * scale - 0.5, 540.0 * scale - 0.5)}
    stated |= {"lens_model": "fisheye", "distortion": (0.0,) * 4}
    camera = Camera.from_calibration(calibration("a", **stated))  # the corners are at 57 degrees
    near, told = fit_brown_lens(camera)
    rays = camera.unproject(camera.image_grid())
    off = near.project(rays.origins + 5.0 * rays.directions) - camera.image_grid()
    assert np.linalg.norm(off, axis=1).max() == pytest.approx(error, rel=0.05)
    assert told["max_error_beyond_px"] == 0.0


def test_the_corners_of_a_very_wide_fisheye_do_not_spoil_the_middle_of_browns_lens():
    # Equidistant with k1 = 0: the corners, 400 px off, are at 400 / 300 rad = 76 degrees.
    stated = {"focal_px": (300.0, 300.0), "principal_point_px": (319.5, 239.5)}
    stated |= {"image_size": (640, 480), "lens_model": "fisheye"}
    camera = Camera.from_calibration(calibration("a", distortion=(0.0,) * 4, **stated))
    near, told = fit_brown_lens(camera)
    assert told["max_error_px"] <= 0.8  # a thousandth of the diagonal
    assert told["max_error_beyond_px"] is None  # the polynomial folds before the corners
    limit = told["fitted_angle_deg"]
    assert 45.0 < limit < 76.5
    # Pixels on a circle about the middle are `radius / 300` rad off the axis.
    turn = np.linspace(0.0, 2.0 * np.pi, 16)
    for share in (0.1, 0.5, 0.95):
        radius = 300.0 * np.radians(share * limit)
        pixels = np.array([319.5, 239.5]) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        pixels = pixels[(np.abs(pixels[:, 1] - 239.5) <= 240.0)]
        rays = camera.unproject(pixels)
        off = near.project(rays.origins + 5.0 * rays.directions) - pixels
        assert np.linalg.norm(off, axis=1).max() <= 1.05 * told["max_error_px"]
    # At 180 px per rad, half of the image is beyond 70 degrees.
    wider = Camera.from_calibration(
        calibration("a", distortion=(0.0,) * 4, **stated | {"focal_px": (180.0, 180.0)})
    )
    with pytest.raises(InputError, match="half of the image"):
        fit_brown_lens(wider)
