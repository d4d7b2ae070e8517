"""Second-order camera and covariance along ill-conditioned directions.

With a long lens and clicks close together, focal length and distance trade off along a curve that
departs from its tangent at the best camera: cameras on the curve fit nearly as well, but a
first-order covariance excludes them. With two parallel lines and one across them, only the prior
determines distance, height and focal length; all other uncertainties are a thousand times smaller,
and the tangent is no approximation over that length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from data_contracts.arrays import Flags, Floats
from worldpose.geometry.camera_model import STEP, step_row
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.covariance import invert_free
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.pitch.template import Surface
from worldpose.static_calibration.fit import CameraProblem, compute_residuals
from worldpose.static_calibration.line_search import Bars
from worldpose.static_calibration.parameters import CameraOnPitch, step_camera, step_jacobian
from worldpose.static_calibration.residuals import PRIORS, prior_residuals


def add_curvature(problem: CameraProblem, row: Floats, covariance: Floats, scale: float) -> Floats:
    """Return the covariance (12, 12) about the best camera (WIDTH,), to second order.

    Along one standard deviation t of the step, the best cameras bend away by ``a(t, t) / 2``, with
    ``a = -C J' r''`` of the whitened residuals' second differences (the Gauss-Newton answer to
    them). For a Gaussian along the tangents this adds half the sum of ``a a'`` over pairs of
    directions, and the square of the mean bend. The covariance (12, 12) is that to first order, the
    scale a factor on the stated noise of the evidence.
    """
    free = np.ix_(problem.free, problem.free)
    size = np.sqrt(np.diag(covariance[free]))
    values, vectors = np.linalg.eigh(covariance[free] / np.outer(size, size))
    steps = np.zeros((len(size), STEP))
    steps[:, problem.free] = (vectors * np.sqrt(np.maximum(values, 0.0))).T * size
    middle, jacobian = whiten_residuals(problem, row, np.zeros(STEP), scale)
    answer = -covariance @ jacobian.T
    at = {
        sign: np.array([whiten_residuals(problem, row, sign * step, scale)[0] for step in steps])
        for sign in (-1.0, 1.0)
    }
    own = (at[1.0] + at[-1.0] - 2.0 * middle) @ answer.T
    added = 0.5 * own.T @ own
    for first in range(len(steps)):
        for second in range(first):
            both = steps[first] + steps[second]
            ahead = whiten_residuals(problem, row, both, scale)[0]
            cross = ahead - at[1.0][first] - at[1.0][second] + middle
            bend = answer @ cross
            added += np.outer(bend, bend)
    mean = 0.5 * own.sum(axis=0)
    return np.asarray(covariance + added + np.outer(mean, mean))


def linearize_at(
    problem: CameraProblem, row: Floats, scale: float, surface: Surface
) -> CameraOnPitch:
    """Return the Gaussian of clicks and priors, linearized at a given camera (WIDTH,) and surface.

    A Gaussian about the clicks' own best camera is wrong at a distant camera along an ill-
    conditioned direction, such as one from the painted lines; this Gaussian is correct there. The
    scale is a factor on the stated noise of the evidence.
    """
    residuals, rows = weight_residuals(problem, row, scale, surface)
    free = free_on_pitch(problem)
    # A pose prior [m, rad] keeps the covariance finite in directions that clicks do not observe.
    kept = np.concatenate([1.0 / np.array([1.0] * 3 + [100.0] * 3 + [np.inf] * 6), np.zeros(2)])
    rows = np.concatenate([rows, np.diag(kept)])
    covariance = invert_free(rows.T @ rows, free)
    step = -covariance @ (rows[: len(residuals)].T @ residuals)
    camera = Camera.from_numbers(row, problem.image_size)
    here = problem.evidence.surface
    start = CameraOnPitch(step_camera(camera, step[:STEP]), here + step[STEP:], covariance)
    turn = step_jacobian(start.step_to(camera, here))
    return replace(start, covariance=turn @ covariance @ turn.T)


def free_on_pitch(problem: CameraProblem) -> Flags:
    """Return the (14,) mask of free parameters of the camera, and of the surface."""
    return np.concatenate([problem.free, [True, True]])


def weight_residuals(
    problem: CameraProblem, row: Floats, scale: float, surface: Surface
) -> tuple[Floats, Floats]:
    """Return residuals (m,) at a camera (WIDTH,), and derivatives (m, 14), times root weights.

    The last two residuals are those of the surface's prior. The scale is a factor on the stated
    noise.
    """
    nudge_m = 0.01  # of crown and end fall, for finite differences
    residuals, by_camera = whiten_residuals(problem, row, np.zeros(STEP), scale)
    columns = []
    for change in nudge_m * np.eye(2):
        there = problem.evidence.on_surface(problem.evidence.surface + change)
        other = replace(problem, evidence=there)
        columns.append(whiten_residuals(other, row, np.zeros(STEP), scale)[0] - residuals)
    rows = np.column_stack([by_camera, np.stack(columns, axis=-1) / nudge_m])
    drawn = slice(2 * len(problem.evidence.points), len(residuals) - PRIORS)
    root = np.ones(len(residuals))
    root[drawn] = 1.0 / np.hypot(1.0, scale * residuals[drawn] / problem.drawn_loss)
    prior, by_surface = surface.whiten(problem.evidence.surface)
    own = np.concatenate([np.zeros((2, STEP)), by_surface], axis=1)
    return (np.concatenate([root * residuals, prior]), np.concatenate([root[:, None] * rows, own]))


def whiten_residuals(
    problem: CameraProblem, row: Floats, step: Floats, scale: float
) -> tuple[Floats, Floats]:
    """Return residuals (m,) in standard deviations after a step, and derivatives (m, 12)."""
    moved = row.copy()
    step_row(row, step, moved)
    found = compute_residuals(problem, moved)
    known, by_known = np.empty(PRIORS), np.empty((PRIORS, STEP))
    prior_residuals(moved, problem.prior, known, by_known)
    noise = scale * problem.click_noise
    drawn_noise = scale * problem.drawn_noise
    residuals = [(found.click / noise[:, None]).ravel(), found.drawn / drawn_noise, known]
    rows = [
        (found.by_click / noise[:, None, None]).reshape(-1, STEP),
        found.by_drawn / drawn_noise[:, None],
        by_known * problem.free,
    ]
    return np.concatenate(residuals), np.concatenate(rows)


@dataclass(frozen=True, eq=False)
class ClicksAndBars:
    """ClickEvidence of a camera after line refinement: clicks, bars on lines, and priors.

    The scale is a factor on the stated noise of the clicks.
    """

    problem: CameraProblem
    scale: float
    bars: Bars
    surface: Surface

    def residuals(self, camera: Camera, surface: Floats) -> tuple[Floats, Floats]:
        """Return whitened residuals (m,) and derivatives (m, f) by the free parameters."""
        there = replace(self.problem, evidence=self.problem.evidence.on_surface(surface))
        clicks, by_clicks = weight_residuals(there, camera.numbers, self.scale, self.surface)
        lines, by_lines = self.bars.whiten_residuals(camera, surface)
        rows = np.concatenate([by_clicks, by_lines])[:, free_on_pitch(self.problem)]
        return np.concatenate([clicks, lines]), rows

    def fit(
        self, camera: Camera, surface: Floats, noise: Floats | None = None
    ) -> tuple[Camera, Floats]:
        """Return the camera and the surface (2,) [m] of least cost near given ones.

        The noise (m,) is added to the residuals; None = none.
        """
        free = free_on_pitch(self.problem)

        def reach(camera: Camera, surface: Floats, length: float) -> _Reached:
            residuals, rows = self.residuals(camera, surface)
            return _Reached(
                camera, surface, residuals if noise is None else residuals + noise, rows, length
            )

        def step(state: _Reached, divisor: float) -> _Reached:
            # The rows are well determined: a step that is too long is shortened, not damped.
            whole = np.zeros(len(free))
            whole[free] = state.full_step / divisor
            length = float(np.linalg.norm(state.rows @ whole[free]))
            camera, surface = step_camera(state.camera, whole[:STEP]), state.surface + whole[STEP:]
            return reach(camera, surface, length)

        found = minimize(
            reach(camera, surface, np.inf),
            step,
            Damping(start=1.0, decrease=np.inf, lowest=1.0, highest=32.0, increase=2.0),
            iterations=120,
            converged=lambda before, after: after.cost < before.cost and after.length < 0.01,
        )
        return found.state.camera, found.state.surface


@dataclass(frozen=True, eq=False)
class _Reached:
    """A camera and a surface on the way to the best ones.

    Attributes:
        surface: (2,) [m].
        residuals: (m,) whitened; NaN for points that the camera does not see.
        rows: (m, f) their derivatives by free parameters.
        length: length of the step here [standard deviations of the residuals].
    """

    camera: Camera
    surface: Floats
    residuals: Floats
    rows: Floats
    length: float

    @cached_property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float((self.residuals**2).sum())

    @cached_property
    def full_step(self) -> Floats:
        """Gauss-Newton step (f,) of the free parameters."""
        size = np.linalg.norm(self.rows, axis=0)
        return np.asarray(-np.linalg.lstsq(self.rows / size, self.residuals)[0] / size)


def fit_with_curvature(evidence: ClicksAndBars, camera: Camera) -> CameraOnPitch:
    """Return camera and surface fitted to clicks and lines, with a covariance to second order.

    The function samples noise of clicks, prior and bars, and fits a camera to each sample. To first
    order these cameras have the inverse information as covariance; the function adds the mean
    square of their deviations from the tangent.
    """
    max_deviation = 0.3  # from the tangent, root mean square [standard deviations]
    test_draws = 8  # cameras before the linearity test
    camera, surface = evidence.fit(camera, evidence.bars.surface)
    rows = evidence.residuals(camera, surface)[1]
    best = CameraOnPitch(camera, surface, np.empty(0))
    free = free_on_pitch(evidence.problem)
    size = 1.0 / np.linalg.norm(rows, axis=0)
    answer = np.linalg.pinv(rows * size)
    covariance = answer @ answer.T
    # A fixed seed: the same evidence gives bitwise equal results.
    rng = np.random.default_rng(0)
    deviations: list[Floats] = []
    for _ in range(64 // 2):
        noise = rng.standard_normal(len(rows))
        for sign in (1.0, -1.0):
            tangent = -sign * size * (answer @ noise)
            sampled = best.step_to(*evidence.fit(camera, surface, sign * noise))
            deviations.append((sampled[free] - tangent) / size)
        if len(deviations) == test_draws:
            rest = np.array(deviations)
            if (rest * np.linalg.solve(covariance, rest.T).T).sum() < test_draws * max_deviation**2:
                break
    rest = np.array(deviations)
    whole = np.zeros((len(free), len(free)))
    whole[np.ix_(free, free)] = (covariance + rest.T @ rest / len(rest)) * np.outer(size, size)
    return replace(best, covariance=whole)
