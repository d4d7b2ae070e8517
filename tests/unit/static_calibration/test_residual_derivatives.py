"""Every derivative of stages 1 and 2 against finite differences."""

import clicking_people as people
import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import Surface
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.curvature_correction import ClicksAndBars, free_on_pitch
from worldpose.static_calibration.evidence import gather_evidence
from worldpose.static_calibration.fit import build_problem
from worldpose.static_calibration.ground_error import surface_motion
from worldpose.static_calibration.line_samples import PaintNoise, project_lines, sample_markings
from worldpose.static_calibration.line_search import Bars
from worldpose.static_calibration.parameters import step_camera
from worldpose.static_calibration.residuals import click_residuals, drawn_residuals, prior_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings

SETTINGS = StaticCalibrationSettings()
# Steps at which truncation and rounding of a central difference balance, by parameter.
STEPS = np.array([1e-6] * 3 + [1e-4] * 3 + [1e-6] + [1e-3] * 2 + [1e-6] * 3)
OFF = np.array([0.01, -0.01, 0.02, 0.3, 0.2, -0.4, 0.02, 3.0, -4.0, 0.01, 0.002, 0.001])


def problem_of(clicked):
    evidence = gather_evidence(people.PITCH, clicked, people.SIZE, 0.5, "test")
    return build_problem(evidence, people.SIZE, SETTINGS)


@pytest.fixture
def problem_and_camera():
    camera, rng = people.seat(1)
    clicks = people.click(camera, rng, count=6).clicked
    drawn = people.draw(camera, people.PITCH.marking_names, rng, noise=5.0)
    return problem_of(clicks.model_copy(update={"drawn": drawn})), step_camera(camera, OFF)


def differences(function, camera):
    columns = [
        (function(step_camera(camera, step)) - function(step_camera(camera, -step))) / (2 * size)
        for step, size in zip(np.diag(STEPS), STEPS, strict=True)
    ]
    return np.stack(columns, axis=-1)


def kernel(function, rows, *given):
    """The residuals and derivatives that a kernel writes for a camera."""

    def at(camera):
        out = np.empty(rows), np.empty((*rows, 12))
        function(camera.numbers, *given, *out)
        return out

    return at


def test_residuals_of_clicks(problem_and_camera):
    problem, camera = problem_and_camera
    seen = problem.evidence
    at = kernel(click_residuals, (len(seen.points), 2), seen.points_world, seen.points_image)
    numeric = differences(lambda view: at(view)[0], camera)
    # Of derivatives up to 1e4 px/rad.
    np.testing.assert_allclose(at(camera)[1], numeric, rtol=1e-5, atol=1e-3)


def test_distances_of_drawn_pixels(problem_and_camera):
    problem, camera = problem_and_camera
    seen = problem.evidence
    given = (seen.samples_world, seen.bounds, seen.drawn_image, seen.drawn_marking)
    at = kernel(drawn_residuals, (len(seen.drawn_image),), problem.half_diagonal, *given)
    residual, analytic = at(camera)
    numeric = differences(lambda view: np.abs(at(view)[0]), camera)
    # The normal is a chord's: it turns by up to a few milliradians within one.
    size = np.abs(analytic).max(axis=0)
    found = np.sign(residual)[:, None] * analytic / size
    np.testing.assert_allclose(found, numeric / size, atol=0.01)


@pytest.mark.parametrize("k1", [0.0, 0.03])
def test_residuals_of_the_prior(problem_and_camera, k1):
    problem, camera = problem_and_camera
    prior = problem.prior.copy()
    prior[18] = k1
    at = kernel(prior_residuals, (9,), prior)
    numeric = differences(lambda view: at(view)[0], camera)
    np.testing.assert_allclose(at(camera)[1], numeric, rtol=1e-5, atol=1e-6)


def test_the_motion_of_the_ground_under_a_step():
    camera, rng = people.seat(2)
    places = people.on_the_pitch(rng, 40)
    seen = camera.project(places)
    places = places[((seen > 0) & (seen < np.array(people.SIZE))).all(axis=1)]
    motion = surface_motion(camera, people.PITCH, places)
    step = 1e-6 * np.random.default_rng(1).standard_normal(12)
    moved = people.ground_errors(step_camera(camera, step), camera, places)
    assert len(places) > 10
    np.testing.assert_allclose(moved, np.linalg.norm(motion @ step, axis=1), rtol=1e-3, atol=1e-9)


def test_samples_of_lines_and_of_clicks_with_bars():
    # Sees one corner of a penalty area, and the touch line beyond it.
    rng = np.random.default_rng(3)
    camera = place_camera(SCENARIOS["sparse-corner"].rig, 3, np.zeros(3), PitchSpec(), rng)
    samples, noise = sample_markings(people.PITCH, 0.5), PaintNoise(0.006, 0.001, 0.05, 1.0)
    lines = project_lines(camera, samples, 0.12, noise)
    here = lines.visible
    assert here.sum() > 50
    numeric = differences(lambda view: view.project(samples.points_world[here]), camera)
    numeric = np.einsum("na,nak->nk", lines.normals[here], numeric)
    size = np.abs(numeric).max(axis=0)
    np.testing.assert_allclose(lines.by_camera[here, :12] / size, numeric / size, atol=1e-5)
    problem = problem_of(people.points(people.visible(camera, ["penalty_area_left_near_front"])))
    surface = np.array([people.PITCH.crown, people.PITCH.end_fall])
    exact = (samples[here], lines.places[here], np.full(here.sum(), 0.02), surface)
    bars = Bars(*exact, lines.by_paint[here], lines.unknowns[here], noise)
    given = ClicksAndBars(problem, 1.0, bars, Surface.of(people.PITCH))
    rows = given.residuals(camera, surface)[1]
    for column, parameter in enumerate(np.flatnonzero(free_on_pitch(problem))):
        step = np.zeros(14)
        step[parameter] = 1e-5 if parameter in (0, 1, 2, 6) else 1e-3
        ahead, behind = (
            given.residuals(step_camera(camera, by[:12]), surface + by[12:])[0]
            for by in (step, -step)
        )
        slope = (ahead - behind) / (2.0 * step[parameter])
        # Exact bars: residuals are zero, and so is what the turning normals would add.
        scale = np.abs(rows[:, column]).max()
        assert rows[:, column] == pytest.approx(slope, rel=1e-3, abs=1e-4 * scale)
