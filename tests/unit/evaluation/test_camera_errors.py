"""Cases T to X of docs/reference/metrics.md, and what must hold for any camera."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import plain_camera

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.evaluation.cameras import (
    CameraErrorSettings,
    camera_samples,
    evaluate_cameras,
    surface_points,
)
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

FLAT = PitchTemplate.from_spec(PitchSpec(crown=0.0))
CROWNED = PitchTemplate.standard()

# x right, y towards the near touch line, looking down.
DOWN = np.diag([1.0, -1.0, -1.0])
# x right, looking along y.
AHEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def camera(rotation=DOWN, center=(0.0, 0.0, 50.0), focal=1000.0):
    return plain_camera(focal, (959.5, 539.5), Rigid(rotation, -rotation @ np.array(center)))


def tilted(down, center):
    """Looks along y, down by an angle [rad]."""
    return camera(Rigid.from_rotvec([down, 0.0, 0.0], np.zeros(3)).rotation @ AHEAD, center, 3000.0)


def errors(estimated, true, pitch=FLAT, **settings):
    found, cameras = evaluate_cameras(
        {"a": estimated}, {"a": true}, pitch, CameraErrorSettings(**settings)
    )
    assert cameras[0].errors == (found.static or found.broadcast)
    return cameras[0].errors


def test_the_true_camera_has_no_error():
    true = tilted(0.2, (3.0, -70.0, 15.0))
    found = errors(true, true, CROWNED)
    for name, value in found.model_dump().items():
        # Back-projection from 100 m, rounded; 1 is the number of cameras and their coverage.
        assert value == pytest.approx(float(name in ("cameras", "coverage")), abs=1e-9)


def test_case_t_a_camera_shifted_by_30_centimetres():
    found = errors(camera(center=(0.3, 0.0, 50.0)), camera())
    assert found.center_error_m == pytest.approx(0.3, abs=1e-12)
    assert found.ground_error_median_m == pytest.approx(0.3, abs=1e-12)
    assert found.ground_error_p95_m == pytest.approx(0.3, abs=1e-12)
    # 1000 px times 0.3 m over the 49 m from the camera to the points 1 m above the pitch.
    assert found.reprojection_error_median_px == pytest.approx(300 / 49, abs=1e-9)
    assert (found.rotation_error_deg, found.focal_error_percent) == (0.0, 0.0)


def test_case_u_a_focal_length_one_per_cent_too_long():
    samples = camera_samples("a", camera(focal=1010.0), camera(), FLAT, CameraErrorSettings())
    points, _ = grid_in_view(camera())
    expected = np.linalg.norm(points[:, :2], axis=-1) * (1.0 - 1.0 / 1.01)
    np.testing.assert_allclose(np.sort(samples.ground), np.sort(expected), atol=1e-12)
    assert errors(camera(focal=1010.0), camera()).focal_error_percent == pytest.approx(1.0)


def grid_in_view(true):
    """The default grid on the flat pitch, 2.5 m, within the image of a camera looking down."""
    x, y = np.meshgrid(np.linspace(-52.5, 52.5, 43), np.linspace(-34.0, 34.0, 29), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    pixels = true.project(points)
    inside = np.all((pixels >= -0.5) & (pixels <= [1919.5, 1079.5]), axis=-1)
    return points[inside], pixels[inside]


def test_case_v_a_camera_turned_by_two_degrees_about_its_axis():
    turn = Rigid.from_rotvec([0.0, 0.0, np.radians(2.0)], np.zeros(3)).rotation
    found = errors(camera(turn @ DOWN), camera())
    assert found.rotation_error_deg == pytest.approx(2.0, abs=1e-12)
    points, _ = grid_in_view(camera())
    expected = 2.0 * np.sin(np.radians(1.0)) * np.linalg.norm(points, axis=-1)
    assert found.ground_error_median_m == pytest.approx(np.median(expected), abs=1e-12)
    assert found.ground_error_p95_m == pytest.approx(np.percentile(expected, 95), abs=1e-12)
    assert found.center_error_m == pytest.approx(0.0, abs=1e-12)


def test_case_w_one_pixel_at_a_grazing_angle():
    # From 12 m height, the point 60 m ahead lies atan(0.2) below the horizon; one pixel of 3000
    # more brings the ray down nearer by what two cotangents differ.
    down, height = np.arctan(0.2), 12.0
    true, estimated = (tilted(down + lean, (0.0, -60.0, height)) for lean in (0.0, 1.0 / 3000.0))
    ray = estimated.unproject([[959.5, 539.5]])
    point = surface_points(ray, FLAT)[0]
    expected = 60.0 - height / np.tan(down + 1.0 / 3000.0)
    assert np.linalg.norm(point) == pytest.approx(expected, abs=1e-9)
    assert 0.05 < expected < 0.20
    assert errors(estimated, true).rotation_error_deg == pytest.approx(np.degrees(1 / 3000))


def test_case_x_a_transposed_rotation():
    true = camera(AHEAD, (0.0, -60.0, 15.0))
    pose = true.cam_from_world
    transposed = replace(true, cam_from_world=Rigid(pose.rotation.T, pose.translation))
    found = errors(transposed, true)
    # AHEAD turns by 90 degrees, its transpose by -90.
    assert found.rotation_error_deg == pytest.approx(180.0, abs=1e-9)
    # t = (0, 15, 60): the centre -R t comes to (0, 60, -15).
    assert found.center_error_m == pytest.approx(2.0 * np.hypot(60.0, 15.0), abs=1e-9)
    # From under the ground no ray meets the pitch: the error of all points is its diagonal.
    assert found.ground_error_median_m == pytest.approx(np.hypot(105.0, 68.0), abs=1e-9)


def test_frames_without_an_estimate_lower_coverage_alone():
    true = Camera.stack([camera()] * 4)
    focal = true.focal.copy()
    focal[2] = np.nan
    found = errors(replace(true, focal=focal), true)
    assert (found.coverage, found.center_error_m) == (0.75, 0.0)
    nothing = errors(replace(true, focal=np.full((4, 2), np.nan)), true)
    assert nothing.model_dump(exclude_none=True) == {"coverage": 0.0, "cameras": 1}


def test_moving_cameras_are_broadcast_and_others_static():
    moving = Camera.stack([camera(center=(0.0, 0.0, 50.0 + 0.1 * i)) for i in range(3)])
    found, cameras = evaluate_cameras(
        {"clip": camera(), "b": camera(), "only": camera()},
        {"clip": moving, "b": camera(), "other": camera()},
        FLAT,
    )
    assert [(each.camera_id, each.kind) for each in cameras] == [
        ("clip", "broadcast"),
        ("b", "static"),
    ]
    # 0, 0.1 and 0.2 m.
    assert found.broadcast.center_error_m == pytest.approx(0.1, abs=1e-12)
    assert found.static.center_error_m == 0.0
    assert evaluate_cameras({"x": camera()}, {"y": camera()}, FLAT) == (None, ())


def test_cameras_of_another_length_are_refused():
    with pytest.raises(InputError, match="camera clip: expected 3 frames"):
        evaluate_cameras(
            {"clip": Camera.stack([camera()] * 2)}, {"clip": Camera.stack([camera()] * 3)}, FLAT
        )


def test_rays_over_the_horizon_and_missing_rays_meet_nothing():
    upright = camera(AHEAD, (0.0, -60.0, 15.0))
    points = surface_points(
        upright.unproject([[900.0, 100.0], [900.0, 539.5], [np.nan, 1.0]]), FLAT
    )
    assert np.isnan(points).all()
