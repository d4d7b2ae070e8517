"""Compiled Levenberg-Marquardt loop of stage 2."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.static_calibration.residuals import (
    PRIORS,
    SIZE,
    drawn_residuals,
    point_residuals,
    prior_residuals,
)

TOLERANCE: Final = 1e-10
"""Relative decrease of the cost below which the loop counts as converged."""


class Measurements(NamedTuple):
    """Clicks, drawn markings and prior of a camera fit.

    Attributes:
        points_world: (n, 3) clicked points [m], world.
        points_image: (n, 2) [px].
        samples_world: (s, 3) [m], world, along the drawn markings one after another.
        bounds: (m + 1,) first sample of each marking, and the end.
        drawn_image: (d, 2) drawn pixels [px].
        drawn_marking: (d,) index of the marking of each.
        prior: (21,), see `prior_residuals`.
        free: (12,) parameters to solve for.
        click_noise: (n,) standard deviations, each axis [px].
        drawn_noise: (d,) standard deviations across the marking [px].
        half_diagonal: half of the diagonal of the image [px].
        click_loss: Cauchy scale of clicks [standard deviations]; infinite = least squares.
        drawn_loss: Cauchy scale of drawn pixels [standard deviations].
    """

    points_world: Floats
    points_image: Floats
    samples_world: Floats
    bounds: Integers
    drawn_image: Floats
    drawn_marking: Integers
    prior: Floats
    free: NDArray[np.bool_]
    click_noise: Floats
    drawn_noise: Floats
    half_diagonal: float
    click_loss: float
    drawn_loss: float


class Linearization(NamedTuple):
    """Normal equations linearized at one estimate, written by the kernels.

    Attributes:
        information: (12, 12) information of evidence and prior.
        observed: (12, 12) contribution of the evidence alone.
        gradient: (12,) gradient of the cost.
    """

    information: Floats
    observed: Floats
    gradient: Floats


class Solutions(NamedTuple):
    """Cameras and their costs and information matrices, written by the kernels.

    Attributes:
        rows: (b, 22) starts, replaced by the fitted cameras.
        cost: (b,).
        information: (b, 12, 12) information of evidence and prior.
        observed: (b, 12, 12) contribution of the evidence alone.
    """

    rows: Floats
    cost: Floats
    information: Floats
    observed: Floats


@compile_kernel
def descend(given: Measurements, iterations: int, found: Solutions) -> None:
    """Minimize the cost from each row in place; see `adjustment.adjust`.

    Args:
        given: evidence and prior.
        iterations: at most, per start; 0 only evaluates the starts.
        found: starts in its rows; written.
    """
    rows, cost, information, observed = found.rows, found.cost, found.information, found.observed
    free = given.free
    trial = np.empty(22)
    system = np.empty((SIZE, SIZE))
    gradient = np.empty(SIZE)
    new = Linearization(np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty(SIZE))
    step = np.empty(SIZE)
    for b in range(len(rows)):
        trial[:] = rows[b]
        cost[b] = np.inf
        damping = 1e-3
        stalled = 0
        iteration = 0
        while True:
            reached = _linearize(trial, given, new)
            if reached < cost[b] or iteration == 0:
                stalled = stalled + 1 if cost[b] - reached < TOLERANCE * cost[b] else 0
                rows[b] = trial
                cost[b] = reached
                information[b] = new.information
                observed[b] = new.observed
                gradient[:] = new.gradient
                damping = max(0.1 * damping, 1e-9)
            else:
                damping *= 8.0
            if iteration >= iterations or stalled >= 2 or damping > 1e8:
                break
            iteration += 1
            system[:] = information[b]
            for j in range(SIZE):
                system[j, j] = system[j, j] * (1.0 + damping) if free[j] else 1.0
            step[:] = gradient
            _solve(system, step)
            step_row(rows[b], step, trial)


@compile_kernel
def _linearize(c: Floats, given: Measurements, written: Linearization) -> float:
    """Return the cost at a camera; write information and gradient, zero for fixed parameters."""
    information, observed, gradient = written.information, written.observed, written.gradient
    free, spread, drawn_spread = given.free, given.click_noise, given.drawn_noise
    n, d = len(given.points_world), len(given.drawn_image)
    click = np.empty((n, 2))
    by_click = np.empty((n, 2, SIZE))
    off = np.empty(d)
    by_off = np.empty((d, SIZE))
    known = np.empty(PRIORS)
    by_known = np.empty((PRIORS, SIZE))
    point_residuals(c, given.points_world, given.points_image, click, by_click)
    drawn_residuals(
        c,
        given.half_diagonal,
        given.samples_world,
        given.bounds,
        given.drawn_image,
        given.drawn_marking,
        off,
        by_off,
    )
    prior_residuals(c, given.prior, known, by_known)
    gradient[:] = 0.0
    observed[:] = 0.0
    for i in range(n):
        weight = _weight((click[i, 0] ** 2 + click[i, 1] ** 2) / spread[i] ** 2, given.click_loss)
        weight /= spread[i] ** 2
        for k in range(2):
            _add(by_click[i, k], click[i, k], weight, observed, gradient)
    for i in range(d):
        weight = _weight((off[i] / drawn_spread[i]) ** 2, given.drawn_loss) / drawn_spread[i] ** 2
        _add(by_off[i], off[i], weight, observed, gradient)
    information[:] = observed
    for i in range(PRIORS):
        _add(by_known[i], known[i], 1.0, information, gradient)
    for j in range(SIZE):
        if not free[j]:
            information[j, :] = information[:, j] = 0.0
            observed[j, :] = observed[:, j] = 0.0
            gradient[j] = 0.0
    return _cost(click, off, known, given)


@compile_kernel
def _solve(system: Floats, right: Floats) -> None:
    """Solve a damped system in place by Cholesky factorization; write minus the solution.

    If rounding makes the system indefinite, the step is NaN and the loop rejects it.
    """
    for j in range(SIZE):
        for k in range(j + 1):
            value = system[j, k]
            for m in range(k):
                value -= system[j, m] * system[k, m]
            system[j, k] = np.sqrt(value) if j == k else value / system[k, k]
    for j in range(SIZE):
        for k in range(j):
            right[j] -= system[j, k] * right[k]
        right[j] /= system[j, j]
    for j in range(SIZE - 1, -1, -1):
        for k in range(j + 1, SIZE):
            right[j] -= system[k, j] * right[k]
        right[j] /= system[j, j]
    for j in range(SIZE):
        right[j] = -right[j]


@compile_kernel
def _add(by: Floats, residual: float, weight: float, system: Floats, gradient: Floats) -> None:
    for j in range(SIZE):
        scaled = weight * by[j]
        gradient[j] += scaled * residual
        for k in range(SIZE):
            system[j, k] += scaled * by[k]


@compile_kernel
def _weight(squared: float, scale: float) -> float:
    """Return the Cauchy weight of a squared residual; 1 for an infinite scale."""
    return 1.0 / (1.0 + squared / (scale * scale))


@compile_kernel
def _loss(squared: float, scale: float) -> float:
    return scale * scale * np.log1p(squared / (scale * scale)) if scale < np.inf else squared


@compile_kernel
def _cost(click: Floats, off: Floats, known: Floats, given: Measurements) -> float:
    spread, drawn_spread = given.click_noise, given.drawn_noise
    total = 0.0
    for i in range(len(click)):
        squared = (click[i, 0] ** 2 + click[i, 1] ** 2) / spread[i] ** 2
        total += _loss(squared, given.click_loss)
    for i in range(len(off)):
        total += _loss((off[i] / drawn_spread[i]) ** 2, given.drawn_loss)
    for i in range(len(known)):
        total += known[i] ** 2
    return 0.5 * total if total < np.inf else np.inf


@compile_kernel
def step_row(c: Floats, step: Floats, out: Floats) -> None:
    """Write the row after a step, as `step_camera` does."""
    out[:] = c
    out[0] = c[0] * np.exp(step[6])
    out[1] = c[1] * np.exp(step[6])
    out[2] += step[7]
    out[3] += step[8]
    out[4] += step[9]
    out[5] += step[10]
    out[8] += step[11]
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    first = np.sin(angle) / angle if angle > 1e-12 else 1.0
    second = (1.0 - np.cos(angle)) / angle**2 if angle > 1e-6 else 0.5
    # Rodrigues' formula on every column of the rotation, and on the translation.
    for k in range(4):
        i = 18 if k == 3 else 9 + k
        s = 1 if k == 3 else 3
        x, y, z = c[i], c[i + s], c[i + 2 * s]
        cx = step[1] * z - step[2] * y
        cy = step[2] * x - step[0] * z
        cz = step[0] * y - step[1] * x
        out[i] = x + first * cx + second * (step[1] * cz - step[2] * cy)
        out[i + s] = y + first * cy + second * (step[2] * cx - step[0] * cz)
        out[i + 2 * s] = z + first * cz + second * (step[0] * cy - step[1] * cx)
    for k in range(3):
        out[18 + k] += step[3 + k]
