"""Second-order camera and covariance along ill-conditioned directions (C4).

With a long lens and clicks close together, focal length and distance trade off along a curve that
departs from its tangent at the best camera: cameras on the curve fit nearly as well, but a
first-order covariance excludes them. With two parallel lines and one across them, only the prior
determines distance, height and focal length; all other uncertainties are a thousand times smaller,
and the tangent is no approximation over that length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.static_calibration.adjustment import Problem, camera_from_row, camera_row
from worldpose.static_calibration.descent import step_row
from worldpose.static_calibration.line_search import Bars
from worldpose.static_calibration.parameters import (
    CameraEstimate,
    step_between,
    step_camera,
    step_jacobian,
)
from worldpose.static_calibration.residuals import (
    PRIORS,
    SIZE,
    drawn_residuals,
    point_residuals,
    prior_residuals,
)

_POSE_SPREAD: Final = np.array([1.0] * 3 + [100.0] * 3 + [np.inf] * 6)
"""Pose prior of a camera refined on painted lines [rad, m]: far wider than its uncertainty; it
keeps the covariance finite in directions that the clicks do not observe."""


def add_curvature(problem: Problem, row: Floats, covariance: Floats, scale: float) -> Floats:
    """Return the covariance (12, 12) about the best camera, to second order.

    Along one standard deviation t of the step, the best cameras bend away by
    ``a(t, t) / 2``, with ``a = -C J' r''`` of the whitened residuals' second differences
    (the Gauss-Newton answer to them). For a Gaussian along the tangents this adds half the sum
    of ``a a'`` over pairs of directions, and the square of the mean bend.

    Args:
        problem: evidence, noise and prior of the fit.
        row: (22,) the best camera.
        covariance: (12, 12) to first order.
        scale: factor on the stated noise of the evidence.
    """
    free = np.ix_(problem.free, problem.free)
    size = np.sqrt(np.diag(covariance[free]))
    values, vectors = np.linalg.eigh(covariance[free] / np.outer(size, size))
    steps = np.zeros((len(size), SIZE))
    steps[:, problem.free] = (vectors * np.sqrt(np.maximum(values, 0.0))).T * size
    middle, jacobian = whiten_residuals(problem, row, np.zeros(SIZE), scale)
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


def linearize_at(problem: Problem, row: Floats, scale: float) -> CameraEstimate:
    """Return the Gaussian of clicks and prior, linearized at a given camera.

    A Gaussian about the clicks' own best camera is wrong at a distant camera along an
    ill-conditioned direction, such as one from the painted lines; this Gaussian is correct there.

    Args:
        problem: clicks, noise and prior.
        row: (22,) camera near the truth.
        scale: factor on the stated noise of the evidence.
    """
    residuals, rows = weight_residuals(problem, row, scale)
    free = problem.free
    rows = np.concatenate([rows, np.diag(1.0 / _POSE_SPREAD)])[:, free]
    residuals = np.concatenate([residuals, np.zeros(SIZE)])
    size = np.linalg.norm(rows, axis=0)
    shape: Floats = np.linalg.inv((rows / size).T @ (rows / size)) / np.outer(size, size)
    step, covariance = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    step[free] = -shape @ (rows.T @ residuals)
    covariance[np.ix_(free, free)] = shape
    camera = camera_from_row(row, problem.image_size)
    start = step_camera(camera, step)
    turn = step_jacobian(step_between(start, camera))
    return CameraEstimate(start, turn @ covariance @ turn.T)


def weight_residuals(problem: Problem, row: Floats, scale: float) -> tuple[Floats, Floats]:
    """Return residuals (m,) at a camera and derivatives (m, 12), times the roots of their weights.

    Args:
        problem: clicks, noise and prior.
        row: (22,) camera.
        scale: factor on the stated noise of the evidence.
    """
    residuals, rows = whiten_residuals(problem, row, np.zeros(SIZE), scale)
    drawn = slice(2 * len(problem.evidence.points), len(residuals) - PRIORS)
    root = np.ones(len(residuals))
    root[drawn] = 1.0 / np.hypot(1.0, scale * residuals[drawn] / problem.drawn_loss)
    return root * residuals, root[:, None] * rows


def whiten_residuals(
    problem: Problem, row: Floats, step: Floats, scale: float
) -> tuple[Floats, Floats]:
    """Return residuals (m,) in standard deviations after a step, and derivatives (m, 12)."""
    evidence = problem.evidence
    n, d = len(evidence.points), len(evidence.drawn_image)
    moved = row.copy()
    step_row(row, step, moved)
    click, by_click = np.empty((n, 2)), np.empty((n, 2, SIZE))
    drawn, by_drawn = np.empty(d), np.empty((d, SIZE))
    known, by_known = np.empty(PRIORS), np.empty((PRIORS, SIZE))
    point_residuals(moved, evidence.points_world, evidence.points_image, click, by_click)
    drawn_residuals(
        moved,
        problem.half_diagonal,
        evidence.samples_world,
        evidence.bounds,
        evidence.drawn_image,
        evidence.drawn_marking,
        drawn,
        by_drawn,
    )
    prior_residuals(moved, problem.prior, known, by_known)
    noise = scale * problem.click_noise
    drawn_noise = scale * problem.drawn_noise
    residuals = [(click / noise[:, None]).ravel(), drawn / drawn_noise, known]
    rows = [
        (by_click / noise[:, None, None]).reshape(-1, SIZE),
        by_drawn / drawn_noise[:, None],
        by_known,
    ]
    return np.concatenate(residuals), np.concatenate(rows) * problem.free


_MAX_STEPS: Final = 20
"""Gauss-Newton steps at most [1]."""
_SETTLED: Final = 0.01
"""Step length at which the iteration stops [standard deviations]."""
_MAX_HALVINGS: Final = 6
"""Maximum halvings of a step that does not lower the cost [1]."""
_FIRST: Final = 8
_DRAWS: Final = 64
"""Sampled cameras before the linearity test, and in total [1]."""
_STRAIGHT: Final = 0.3
"""Root mean square deviation of the first cameras from their tangents below which sampling stops
[standard deviations]."""


@dataclass(frozen=True, eq=False)
class ClicksAndBars:
    """Evidence of a camera after line refinement: clicks, prior and bars.

    Attributes:
        problem: the clicks and the prior.
        scale: factor on the stated noise of the clicks.
        bars: found on the lines.
    """

    problem: Problem
    scale: float
    bars: Bars

    def residuals(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return whitened residuals (m,) and derivatives (m, f) by the free parameters."""
        clicks, by_clicks = weight_residuals(self.problem, camera_row(camera), self.scale)
        lines, by_lines = self.bars.whiten_residuals(camera)
        rows = np.concatenate([by_clicks, by_lines])[:, self.problem.free]
        return np.concatenate([clicks, lines]), rows

    def fit(self, camera: Camera, noise: Floats | None = None) -> Camera:
        """Return the camera of least cost.

        Args:
            camera: near the answer.
            noise: (m,) to add to the residuals; None = none.
        """
        residuals, rows = self.residuals(camera)
        noise = np.zeros(len(residuals)) if noise is None else noise
        for _ in range(_MAX_STEPS):
            size = np.linalg.norm(rows, axis=0)
            step = np.zeros(SIZE)
            free_step = -np.linalg.lstsq(rows / size, residuals + noise)[0] / size
            before = float(((residuals + noise) ** 2).sum())
            for _ in range(_MAX_HALVINGS):
                step[self.problem.free] = free_step
                trial = step_camera(camera, step)
                ahead, by_ahead = self.residuals(trial)
                # Points that a camera does not see are NaN, which compares false.
                if ((ahead + noise) ** 2).sum() < before:
                    break
                free_step = 0.5 * free_step
            else:
                return camera
            length = float(np.linalg.norm(rows @ free_step))
            camera, residuals, rows = trial, ahead, by_ahead
            if length < _SETTLED:
                break
        return camera


def fit_with_curvature(
    problem: Problem, camera: Camera, bars: Bars, scale: float
) -> CameraEstimate:
    """Return the camera fitted to clicks and lines, with a covariance to second order.

    The function samples noise of clicks, prior and bars, and fits a camera to each sample. To first
    order these cameras have the inverse information as covariance; the function adds the mean
    square of their deviations from the tangent.

    Args:
        problem: the inlying clicks.
        camera: near the answer.
        bars: bars on the lines.
        scale: factor on the stated noise of the clicks.
    """
    evidence = ClicksAndBars(problem, scale, bars)
    camera = evidence.fit(camera)
    rows = evidence.residuals(camera)[1]
    size = 1.0 / np.linalg.norm(rows, axis=0)
    answer = np.linalg.pinv(rows * size)
    covariance = answer @ answer.T
    # A fixed seed: the same evidence gives bitwise equal results.
    rng = np.random.default_rng(0)
    beside: list[Floats] = []
    for _ in range(_DRAWS // 2):
        noise = rng.standard_normal(len(rows))
        for sign in (1.0, -1.0):
            tangent = -sign * size * (answer @ noise)
            there = evidence.fit(camera, sign * noise)
            beside.append((step_between(camera, there)[problem.free] - tangent) / size)
        if len(beside) == _FIRST:
            off = np.array(beside)
            if (off * np.linalg.solve(covariance, off.T).T).sum() < _FIRST * _STRAIGHT**2:
                break
    off = np.array(beside)
    whole = np.zeros((SIZE, SIZE))
    whole[np.ix_(problem.free, problem.free)] = (covariance + off.T @ off / len(off)) * np.outer(
        size, size
    )
    return CameraEstimate(camera, whole)
