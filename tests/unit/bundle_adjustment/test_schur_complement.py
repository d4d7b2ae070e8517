"""The kernels against the plain dense normal equations and against finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.geometry.camera_model import STEP
from worldpose.geometry.optimize.schur_complement import (
    CameraEquations,
    PointObservations,
    cost,
    eliminate,
)
from worldpose.static_calibration.parameters import PARAMETERS, project_with_jacobian, step_camera


def evidence_of(problem):
    first_of = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    return PointObservations(
        problem.points,
        problem.point_information,
        first_of,
        problem.camera_of,
        problem.image,
        problem.weight,
        problem.scale,
    )


def dense_step(problem, points):
    """The Gauss-Newton step of all unknowns, without any elimination."""
    cameras, free = len(problem.free), np.flatnonzero(problem.point_information < np.inf)
    column = {int(p): STEP * cameras + 3 * k for k, p in enumerate(free)}
    jacobian = np.zeros((2 * len(problem.image), STEP * cameras + 3 * len(free)))
    residual = np.zeros(len(jacobian))
    for o, (p, c) in enumerate(zip(problem.point_of, problem.camera_of, strict=True)):
        root = np.sqrt(problem.weight[o])
        pixel, by_step = project_with_jacobian(problem.cameras[c], points[p][None])
        by_point = problem.cameras[c].project_with_jacobians(points[p][None]).d_points[0]
        rows = slice(2 * o, 2 * o + 2)
        residual[rows] = root * (pixel[0] - problem.image[o])
        jacobian[rows, STEP * c : STEP * (c + 1)] = root * by_step[0]
        if p in column:
            jacobian[rows, column[p] : column[p] + 3] = root * by_point
    k3 = [STEP * c + PARAMETERS.index("k3") for c in range(cameras)]
    kept = np.setdiff1d(np.arange(jacobian.shape[1]), k3)
    step = np.zeros(jacobian.shape[1])
    step[kept] = -np.linalg.lstsq(jacobian[:, kept], residual, rcond=None)[0]
    moves = np.zeros_like(points)
    moves[free] = step[STEP * cameras :].reshape(-1, 3)
    return step[: STEP * cameras].reshape(cameras, STEP), moves


def test_the_step_is_that_of_the_dense_normal_equations(scene):
    from worldpose.bundle_adjustment.solver import _System

    problem, _, points = scene(noise=2.0)
    start = points + np.where(np.isinf(problem.point_information), 0.0, 0.1)[:, None]
    step, trial = _System(problem).solve_step(problem.cameras, start, 0.0, np.zeros((4, STEP)))
    expected, moves = dense_step(problem, start)
    # Condition numbers near 1e6 leave ten digits of the largest entries.
    scale = np.abs(expected).max(axis=0) + 1e-12
    np.testing.assert_allclose(step / scale, expected / scale, atol=1e-6)
    np.testing.assert_allclose(trial - start, moves, atol=1e-7)


@pytest.mark.parametrize("scale", [np.inf, 2.0])
def test_the_gradient_is_the_slope_of_the_cost(scene, scale):
    problem, _, points = scene(noise=3.0)
    problem = replace(problem, scale=np.full(len(problem.image), scale))
    evidence = evidence_of(problem)
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


def test_a_point_behind_a_camera_costs_infinitely_much(scene):
    problem, _, points = scene(cameras=2, markings=1, joints=0, seen=1.0)
    behind = problem.cameras.center[0] + (problem.cameras.center[0] - points[0])
    assert cost(problem.cameras.numbers, behind[None], evidence_of(problem)) == np.inf
