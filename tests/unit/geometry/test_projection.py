import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import fold_radius
from worldpose.geometry.rays import RayStatus
from worldpose.geometry.rigid import Rigid


@st.composite
def stadium_cameras(draw, tangential=True) -> Camera:
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


def points_in_view(camera: Camera, seed: int, count: int = 20) -> np.ndarray:
    """World points that a camera without distortion sees inside the image, 30 to 150 m deep."""
    rng = np.random.default_rng(seed)
    size = camera.image_size.astype(float)
    pixels = rng.uniform(-0.5, size - 0.5, (count, 2))
    depth = rng.uniform(30.0, 150.0, (count, 1))
    plane = (pixels - camera.principal_point) / camera.focal
    points_cam = depth * np.concatenate([plane, np.ones((count, 1))], axis=1)
    return camera.cam_from_world.inverse().apply(points_cam)


def opencv(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def central_differences(function, size: int, step: float) -> np.ndarray:
    """Derivatives by `size` parameters around zero, of order step^4, as the last dimension."""

    def difference(k: int, h: float) -> np.ndarray:
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

    def changed(**parts) -> Camera:
        fields = ("focal", "principal_point", "distortion", "cam_from_world", "image_size")
        return Camera(**{name: parts.get(name, getattr(camera, name)) for name in fields})

    cases = [
        (found.d_points, lambda d: camera.project(points + d), 3, 1e-2),
        (
            found.d_pose,
            lambda d: changed(cam_from_world=camera.cam_from_world.retract(d)).project(points),
            6,
            1e-4,
        ),
        (
            found.d_intrinsics,
            lambda d: changed(
                focal=camera.focal + d[:2], principal_point=camera.principal_point + d[2:]
            ).project(points),
            4,
            1.0,
        ),
        (
            found.d_distortion[..., :5],
            lambda d: changed(distortion=camera.coefficients + d).project(points),
            5,
            1e-4,
        ),
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
