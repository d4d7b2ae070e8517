"""Every derivative of stages 1 and 2 against finite differences."""

import clicking_people as people
import numpy as np
import pytest

from worldpose.geometry.cameras import Camera
from worldpose.static_calibration.evidence import gather_evidence
from worldpose.static_calibration.fit import build_problem
from worldpose.static_calibration.parameters import step_camera
from worldpose.static_calibration.residuals import click_residuals, drawn_residuals, prior_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings

# Steps at which truncation and rounding of a central difference balance, by parameter.
STEPS = np.array([1e-6] * 3 + [1e-4] * 3 + [1e-6] + [1e-3] * 2 + [1e-6] * 3)


def problem_and_row(index=1):
    camera, rng = people.seat(index)
    clicks = people.click(camera, rng, count=6).clicked
    drawn = people.draw(camera, people.PITCH.marking_names, rng, noise=5.0)
    clicked = clicks.model_copy(update={"drawn": drawn})
    evidence = gather_evidence(people.PITCH, clicked, people.SIZE, 0.5, "test")
    off = step_camera(
        camera, [0.01, -0.01, 0.02, 0.3, 0.2, -0.4, 0.02, 3.0, -4.0, 0.01, 0.002, 0.001]
    )
    return build_problem(evidence, people.SIZE, StaticCalibrationSettings()), off


def differences(function, camera: Camera):
    columns = []
    for index, size in enumerate(STEPS):
        step = np.zeros(12)
        step[index] = size
        forward, backward = (
            function(step_camera(camera, step)),
            function(step_camera(camera, -step)),
        )
        columns.append((forward - backward) / (2 * size))
    return np.stack(columns, axis=-1)


def test_residuals_of_clicks():
    problem, camera = problem_and_row()
    evidence = problem.evidence

    def residual(at):
        out = np.empty((len(evidence.points), 2)), np.empty((len(evidence.points), 2, 12))
        click_residuals(at.numbers, evidence.points_world, evidence.points_image, *out)
        return out

    np.testing.assert_allclose(
        residual(camera)[1],
        differences(lambda at: residual(at)[0], camera),
        rtol=1e-5,
        atol=1e-3,  # of derivatives up to 1e4 px/rad
    )


def test_distances_of_drawn_pixels():
    problem, camera = problem_and_row()
    evidence = problem.evidence

    def residual(at):
        count = len(evidence.drawn_image)
        out = np.empty(count), np.empty((count, 12))
        drawn_residuals(
            at.numbers,
            problem.half_diagonal,
            evidence.samples_world,
            evidence.bounds,
            evidence.drawn_image,
            evidence.drawn_marking,
            *out,
        )
        return out

    analytic = residual(camera)[1]
    numeric = differences(lambda at: np.abs(residual(at)[0]), camera)
    sign = np.sign(residual(camera)[0])[:, None]
    # The normal is a chord's: it turns by up to a few milliradians within one.
    size = np.abs(analytic).max(axis=0)
    np.testing.assert_allclose(sign * analytic / size, numeric / size, atol=0.01)


@pytest.mark.parametrize("k1", [0.0, 0.03])
def test_residuals_of_the_prior(k1):
    problem, camera = problem_and_row()
    prior = problem.prior.copy()
    prior[18] = k1

    def residual(at):
        out = np.empty(9), np.empty((9, 12))
        prior_residuals(at.numbers, prior, *out)
        return out

    numeric = differences(lambda at: residual(at)[0], camera)
    np.testing.assert_allclose(residual(camera)[1], numeric, rtol=1e-5, atol=1e-6)
