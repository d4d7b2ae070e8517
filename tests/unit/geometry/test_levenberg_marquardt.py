"""The Levenberg-Marquardt loop on problems whose solution is known by hand."""

from dataclasses import dataclass

import numpy as np
import pytest

from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize


@dataclass(frozen=True)
class Point:
    x: np.ndarray
    cost: float


def find_minimum(state, step, iterations=200, **course):
    course = Damping(**{"start": 1e-3, "decrease": 5.0, "lowest": 1e-12, **course})

    def settled(before, after):
        return abs(before.cost - after.cost) <= 1e-14 * before.cost

    return minimize(state, step, course, iterations, settled)


def dense(residuals, jacobian):
    """Return the start of a dense problem, and its damped step."""

    def at(x):
        return Point(x, float((residuals(x) ** 2).sum()))

    def step(point, damping):
        j, r = jacobian(point.x), residuals(point.x)
        normal = j.T @ j
        normal = normal + damping * np.diag(np.diag(normal))
        return at(point.x - np.linalg.lstsq(normal, j.T @ r, rcond=None)[0])

    return at, step


def test_the_minimum_of_rosenbrocks_function_is_at_one_one():
    at, step = dense(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )
    found = find_minimum(at(np.array([-1.2, 1.0])), step)
    np.testing.assert_allclose(found.state.x, [1.0, 1.0], atol=1e-9)
    assert all(
        later < earlier for earlier, later in zip(found.costs, found.costs[1:], strict=False)
    )


def test_a_singular_problem_moves_along_what_its_residuals_determine():
    # Only x + y = 2 is observed.
    at, step = dense(lambda x: np.array([x[0] + x[1] - 2.0]), lambda x: np.array([[1.0, 1.0]]))
    found = find_minimum(at(np.array([3.0, 1.0])), step)
    assert found.state.x.sum() == pytest.approx(2.0, abs=1e-9)
    assert np.isfinite(found.state.x).all()


@pytest.mark.parametrize("cost", [np.inf, np.nan])
def test_a_step_to_a_cost_that_is_not_finite_is_rejected_and_damped(cost):
    asked = []

    def step(point, damping):
        asked.append(damping)
        return Point(point.x + 1.0, cost)

    start = Point(np.zeros(1), 4.0)
    found = find_minimum(start, step, start=1.0, iterations=3)
    assert found.state is start and not found.converged and found.costs == (4.0,)
    assert asked == [1.0, 8.0, 64.0]


def test_the_loop_ends_when_the_damping_passes_its_limit():
    found = find_minimum(
        Point(np.zeros(1), 4.0),
        lambda point, damping: Point(point.x, 5.0),
        start=1.0,
        highest=100.0,
    )
    # 1, 8 and 64 are tried; 512 is beyond the limit.
    assert found.iterations == 3 and not found.converged
