"""Clicks that are worse than stated, or wrong, before an image whose lines tell."""

import clicking_people as people
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.settings import StaticCalibrationSettings

PITCH, SIZE = people.PITCH, people.SIZE
EXACT = StaticCalibrationSettings(survey_error_m=0.0)


@pytest.fixture(scope="module")
def view():
    camera, _ = people.seat(0)
    return camera, render_pitch(camera, PITCH, None, 0)


def median_error(result, camera):
    places = people.on_the_pitch(np.random.default_rng(0))
    return float(np.median(people.ground_errors(result.estimate.camera, camera, places)))


def test_clicks_three_times_worse_than_stated_do_not_keep_the_lines_out(view):
    camera, picture = view
    clicked = people.click(camera, np.random.default_rng(0), count=6, noise=3.5).clicked
    alone = calibrate_camera(PITCH, clicked, SIZE, settings=EXACT)
    both = calibrate_camera(PITCH, clicked, SIZE, picture=picture, settings=EXACT)
    assert both.report.stage == "lines"
    # Lines of an exact template leave millimetres; 3.5 px of few clicks, decimetres.
    assert median_error(both, camera) < 0.01
    assert median_error(both, camera) < 0.2 * median_error(alone, camera)


def test_lines_name_a_wrong_click_among_five(view):
    camera, picture = view
    found = 0
    for seed in range(4):
        clicks = people.click(camera, np.random.default_rng(seed), count=5, wrong=25.0)
        result = calibrate_camera(PITCH, clicks.clicked, SIZE, picture=picture, settings=EXACT)
        found += result.report.wrong == (clicks.first,)
    # Where it drags the five too far, the lines are not found, and the clicks stand.
    assert found >= 3


def test_drawn_edges_of_mowing_stripes_determine_a_camera_with_few_points(view):
    camera, _ = view
    pitch = PitchTemplate.from_spec(PitchSpec(stripes={"spacing": 5.5}))
    rng = np.random.default_rng(2)
    names = sorted(pitch.unpainted)
    drawn = people.draw(camera, names, rng, count=6, noise=0.5, pitch=pitch)
    assert len(drawn) >= 4
    points = people.click(camera, rng, count=4).clicked.points
    alone, both = (
        calibrate_camera(pitch, ClickedMarkings(points=points, drawn=lines), SIZE, settings=EXACT)
        for lines in ((), drawn)
    )
    assert both.report.wrong == ()
    assert median_error(both, camera) < 0.8 * median_error(alone, camera)
