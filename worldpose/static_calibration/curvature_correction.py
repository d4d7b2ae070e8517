"""Second-order correction of a camera's covariance along ill-conditioned directions.

With a long lens and clicks close together, focal length and distance trade off along a curve that
departs from its tangent at the best camera: cameras on the curve fit nearly as well, but a
first-order covariance excludes them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.static_calibration.adjustment import Problem, camera_of_row
from worldpose.static_calibration.descent import step_row
from worldpose.static_calibration.line_search import difference, turned
from worldpose.static_calibration.parameters import CameraEstimate, stepped
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


def with_bends(problem: Problem, row: Floats, covariance: Floats, scale: float) -> Floats:
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
    middle, jacobian = whitened(problem, row, np.zeros(SIZE), scale)
    answer = -covariance @ jacobian.T
    at = {
        sign: np.array([whitened(problem, row, sign * step, scale)[0] for step in steps])
        for sign in (-1.0, 1.0)
    }
    own = (at[1.0] + at[-1.0] - 2.0 * middle) @ answer.T
    added = 0.5 * own.T @ own
    for first in range(len(steps)):
        for second in range(first):
            both = steps[first] + steps[second]
            ahead = whitened(problem, row, both, scale)[0]
            cross = ahead - at[1.0][first] - at[1.0][second] + middle
            bend = answer @ cross
            added += np.outer(bend, bend)
    mean = 0.5 * own.sum(axis=0)
    return np.asarray(covariance + added + np.outer(mean, mean))


def tangent_at(problem: Problem, row: Floats, scale: float) -> CameraEstimate:
    """Return the Gaussian of clicks and prior, linearized at a given camera.

    A Gaussian about the clicks' own best camera is wrong at a distant camera along an
    ill-conditioned direction, such as one from the painted lines; this Gaussian is correct there.

    Args:
        problem: clicks, noise and prior.
        row: (22,) camera near the truth.
        scale: factor on the stated noise of the evidence.
    """
    residuals, rows = weighted(problem, row, scale)
    free = problem.free
    rows = np.concatenate([rows, np.diag(1.0 / _POSE_SPREAD)])[:, free]
    residuals = np.concatenate([residuals, np.zeros(SIZE)])
    size = np.linalg.norm(rows, axis=0)
    shape: Floats = np.linalg.inv((rows / size).T @ (rows / size)) / np.outer(size, size)
    step, covariance = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    step[free] = -shape @ (rows.T @ residuals)
    covariance[np.ix_(free, free)] = shape
    camera = camera_of_row(row, problem.image_size)
    start = stepped(camera, step)
    turn = turned(difference(start, camera))
    return CameraEstimate(start, turn @ covariance @ turn.T)


def weighted(problem: Problem, row: Floats, scale: float) -> tuple[Floats, Floats]:
    """Return residuals (m,) at a camera and derivatives (m, 12), times the roots of their weights.

    Args:
        problem: clicks, noise and prior.
        row: (22,) camera.
        scale: factor on the stated noise of the evidence.
    """
    residuals, rows = whitened(problem, row, np.zeros(SIZE), scale)
    drawn = slice(2 * len(problem.evidence.points), len(residuals) - PRIORS)
    root = np.ones(len(residuals))
    root[drawn] = 1.0 / np.hypot(1.0, scale * residuals[drawn] / problem.drawn_loss)
    return root * residuals, root[:, None] * rows


def whitened(problem: Problem, row: Floats, step: Floats, scale: float) -> tuple[Floats, Floats]:
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
        problem.reach,
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
