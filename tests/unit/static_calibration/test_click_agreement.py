"""Clicks that contradict each other too much for any camera, and the messages about them."""

from types import SimpleNamespace

import clicking_people as people
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.static_calibration import calibration
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.click_outliers import Explanation
from worldpose.static_calibration.settings import StaticCalibrationSettings

NAMES = tuple(f"point{number}" for number in range(10))


def fitted(wrong, misfit=1.0):
    """A fit to ten clicks of which so many are wrong."""
    return SimpleNamespace(inliers=np.arange(10) >= wrong, misfit=misfit)


@pytest.fixture
def judge(monkeypatch):
    """A function that judges ten clicks that no other size of the pitch explains."""
    monkeypatch.setattr(calibration, "_find_size", lambda *_: None)
    monkeypatch.setattr(calibration, "scale_noise", lambda problem, *_: (problem, None))
    problem = SimpleNamespace(where="cam01", evidence=SimpleNamespace(points=NAMES, markings=()))
    settings = StaticCalibrationSettings()
    return lambda fit: calibration.check_agreement(
        Explanation(problem, fit, settings), people.PITCH, settings
    )


def test_with_more_than_four_of_ten_clicks_wrong_no_camera_is_given(judge):
    judge(fitted(4))
    with pytest.raises(InputError, match=r"at most 40% wrong clicks.*50%.*than point5, point6"):
        judge(fitted(5))


def of(clicked, **settings):
    settings = StaticCalibrationSettings(**settings)
    return calibrate_camera(people.PITCH, clicked, people.SIZE, settings=settings)


def test_a_camera_is_weak_where_its_expected_error_is_beyond_a_limit():
    camera, rng = people.seat(1)
    clicked = people.click(camera, rng, count=14).clicked
    error = of(clicked).report.ground_error

    def reasons(median, p95):
        report = of(clicked, weak_median_m=median * error.median, weak_p95_m=p95 * error.p95).report
        assert report.weak == bool(report.reasons)
        return report.reasons

    assert reasons(1.01, 1.01) == ()
    assert ["median over" in reason for reason in reasons(0.99, 1.01)] == [True]
    assert ["worst twentieth" in reason for reason in reasons(1.01, 0.99)] == [True]
