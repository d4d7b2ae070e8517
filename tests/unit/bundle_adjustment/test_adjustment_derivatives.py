"""Derivatives against finite differences, and similarity transforms, which no pixel tells."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import rig

from worldpose.bundle_adjustment.uncertainty import relative_covariance, similarity_steps
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.optimize.schur_complement import (
    CameraEquations,
    PointObservations,
    cost,
    eliminate,
)
from worldpose.static_calibration.parameters import project_with_jacobian, step_camera

ORIGIN = np.array([0.3, -0.2, 1.0])


@pytest.mark.parametrize("scale", [np.inf, 2.0])
def test_the_gradient_is_the_slope_of_the_cost(scene, scale):
    problem, _, points = scene(noise=3.0)
    problem = replace(problem, scale=np.full(len(problem.image), scale))
    first_of = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    evidence = PointObservations(
        *(problem.points, problem.point_information, first_of, problem.camera_of),
        *(problem.image, problem.weight, problem.scale),
    )
    numbers = problem.cameras.numbers
    rows, columns = np.zeros((3 * len(points), 1)), np.full((4, STEP), -1)
    blocks, gradient = np.zeros((4, STEP, STEP)), np.zeros((4, STEP))
    equations = CameraEquations(columns, rows, blocks, gradient)
    eliminate(numbers, points, evidence, 0.0, 0, len(points), equations)
    for parameter in range(STEP):
        step = np.zeros((4, STEP))
        step[1, parameter] = 1e-6
        high = cost(step_camera(problem.cameras, step).numbers, points, evidence)
        low = cost(step_camera(problem.cameras, -step).numbers, points, evidence)
        # The cost is the sum of squares, the gradient that of half of it.
        slope = 0.5 * (high - low) / 2e-6
        assert slope == pytest.approx(gradient[1, parameter], rel=1e-4, abs=1e-2)


@pytest.fixture
def rng():
    return np.random.default_rng(8)


@pytest.mark.parametrize("parameter", range(7))
def test_steps_are_the_derivatives_of_cameras_that_follow(rng, parameter):
    cameras, points = rig(3, rng), rng.normal(0.0, 0.5, (10, 3))
    small = np.zeros(7)
    small[parameter] = 1e-6
    away = points - ORIGIN
    moved = points + small[:3] + np.cross(small[3:6], away) + small[6] * away
    seen = step_camera(cameras, similarity_steps(cameras, ORIGIN) @ small).project(moved)
    # A thousand pixels times the square of the step are left.
    np.testing.assert_allclose(seen, cameras.project(points), atol=1e-8)


def test_what_cameras_err_by_in_common_is_taken_apart(rng):
    cameras, points = rig(4, rng), rng.normal(0.0, 0.5, (40, 3)) + ORIGIN
    by_step = np.stack([project_with_jacobian(camera, points)[1] for camera in cameras])
    information = np.einsum("cnai,cnaj->cij", by_step, by_step)
    steps = similarity_steps(cameras, ORIGIN).reshape(48, 7)
    common = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.005]) ** 2
    own = np.zeros(48)
    relative, together = relative_covariance(
        steps @ common @ steps.T + np.diag(own), cameras, information, ORIGIN
    )
    np.testing.assert_allclose(together, common, atol=1e-10)
    np.testing.assert_allclose(relative, 0.0, atol=1e-10)
    # Independent errors of a millimetre: three of four quarters are relative.
    own.reshape(4, 12)[:, 3:6] = 1e-6
    relative, _ = relative_covariance(np.diag(own), cameras, information, ORIGIN)
    share = np.einsum("cii->c", relative[:, 3:6, 3:6]) / 3e-6
    assert (share > 0.1).all()
    assert (share < 1.0).all()
