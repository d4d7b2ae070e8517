"""The lens model of clicks: chosen by the residuals, never at the cost of right clicks."""

import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.static_calibration import ClickedMarkings, ClickedPoint
from worldpose.geometry.lens_models import LensModel
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera

SIZE = (3840, 2160)
PITCH = PitchTemplate.standard().with_surface(np.zeros(2))
WIDE = ([2.0, -47.0, 13.0], [0.0, -12.0, 0.0])
FAR = ([2.0, -62.0, 14.0], [0.0, -8.0, 0.0])
NOISE_PX = 0.7


def fisheye(*k):
    return lambda t: t * (1.0 + sum(each * t ** (2 * n + 2) for n, each in enumerate(k)))


LENSES = {
    "equidistant_62": (fisheye(-0.06, 0.02, -0.012, 0.003), 62.0, WIDE),
    "equidistant_46": (fisheye(-0.09, -0.004, 0.004, -0.002), 46.0, FAR),
    "equisolid": (lambda t: 2.0 * np.sin(t / 2.0), 60.0, WIDE),
    "stereographic": (lambda t: 2.0 * np.tan(t / 2.0), 55.0, WIDE),
    "mustache": (
        lambda t: np.polynomial.Polynomial([0, 1, 0, -0.3, 0, 0.16, 0, -0.028])(np.tan(t)),
        *(50.0, WIDE),
    ),
    "brown": (lambda t: np.tan(t) - 0.05 * np.tan(t) ** 3, 40.0, FAR),
    "wavy": (lambda t: t + 0.01 * np.sin(8.0 * t), 60.0, WIDE),
}
"""Radius by the angle from the axis, angle at half the width [deg], and the place."""


def seen_by(name, places):
    """Pixels of places (n, 3) [m] through a lens."""
    radius, half, (center, aim) = LENSES[name]
    focal = 0.5 * SIZE[0] / radius(np.radians(half))
    x, y, z = look_at_camera(center, aim, focal, SIZE).cam_from_world.apply(places).T
    length = focal * radius(np.arctan2(np.hypot(x, y), z))
    along = np.stack([x, y], axis=-1) / np.hypot(x, y)[:, None]
    return 0.5 * (np.array(SIZE) - 1.0) + length[:, None] * along


def inside(pixels):
    return ((pixels > 2.0) & (pixels < np.array(SIZE) - 3.0)).all(axis=1)


def calibrate(lens, seed, count=None):
    """The calibration of clicks on all points, or on some, and true ground errors."""
    rng = np.random.default_rng(seed)
    names = [name for name in PITCH.points if not name.startswith(("goal_post", "goal_crossbar"))]
    places = np.array([PITCH.points[name] for name in names])
    names = [name for name, low in zip(names, places[:, 2] == 0.0, strict=True) if low]
    pixels = seen_by(lens, places[places[:, 2] == 0.0])
    pixels += rng.normal(0.0, NOISE_PX, pixels.shape)
    points = [
        ClickedPoint(name=name, xy=tuple(xy))
        for name, xy, kept in zip(names, pixels.tolist(), inside(pixels), strict=True)
        if kept
    ]
    points = [points[n] for n in rng.permutation(len(points))[:count]]
    found = calibrate_camera(PITCH, ClickedMarkings(points=tuple(points)), SIZE)
    x, y = np.meshgrid(np.linspace(-50.0, 50.0, 11), np.linspace(-30.0, 32.0, 7))
    ground = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    pixels = seen_by(lens, ground)
    rays = found.estimate.camera.unproject(pixels[inside(pixels)])
    hit = rays.origins - (rays.origins[:, 2] / rays.directions[:, 2])[:, None] * rays.directions
    return found, np.linalg.norm(hit - ground[inside(pixels)], axis=1)


@pytest.fixture(scope="module", params=LENSES)
def calibrated(request):
    """Name of the lens, the calibration of clicks on all points, and true ground errors."""
    return request.param, *calibrate(request.param, 20)


def test_right_clicks_stay_and_the_stated_error_holds_or_the_lens_is_told(calibrated):
    name, found, errors = calibrated
    report = found.report
    told = [each for each in report.reasons if "the lens bends the image" in each]
    if name == "wavy":  # no model follows it
        assert told
        return
    assert not told
    assert not report.wrong
    assert np.quantile(errors, 0.95) < 2.0 * report.ground_error.p95 < 0.6


@pytest.mark.parametrize("lens", sorted(LENSES.keys() - {"wavy"}))
def test_few_clicks_state_the_error_of_lenses_that_fit_them_as_well(lens):
    for count in (8, 12):
        for seed in range(3):
            found, errors = calibrate(lens, seed, count)
            # NaN is beyond the fold of the lens. Without the other lenses, ratios are up to 5.4.
            assert np.nanquantile(errors, 0.95) < 2.0 * found.report.ground_error.p95
    if lens == "brown":
        assert found.report.ground_error.p95 < 0.35


def test_browns_model_stands_unless_a_fisheye_is_clearly_more_probable(calibrated):
    name, found, _ = calibrated
    expected = LensModel.BROWN if name == "brown" else LensModel.FISHEYE
    assert found.estimate.camera.lens_model == expected
    if expected == LensModel.FISHEYE:
        assert any("fisheye lens" in each for each in found.report.decisions)
