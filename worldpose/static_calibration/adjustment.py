"""Levenberg-Marquardt on clicks, drawn markings and priors, compiled (C3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.cameras import LensCalibration
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.static_calibration.evidence import Evidence, count_neighbors
from worldpose.static_calibration.parameters import (
    PARAMETERS,
    PRIORS,
    SIZE,
    drawn_residuals,
    point_residuals,
    prior_residuals,
)
from worldpose.static_calibration.settings import StaticCalibrationSettings

_ITERATIONS: Final = 60
"""Enough from any start in the basin; most end after ten."""
TOLERANCE: Final = 1e-10
"""Relative decrease of the cost below which the loop counts as converged."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Observations, noise and prior of a camera fit, as the compiled kernels expect them.

    Attributes:
        evidence: clicks and drawn markings.
        image_size: width, height [px].
        prior: (21,), see `prior_residuals`.
        free: (12,) parameters to solve for.
        click_noise: (n,) standard deviation of each click, each axis [px].
        drawn_noise: (d,) standard deviation of each drawn pixel, across its marking [px]: larger
            where other pixels are close.
        drawn_loss: Cauchy scale of drawn points [standard deviations].
        where: file or camera, for messages.
        lens: the given lens that `prior` contains; None = none is known.
    """

    evidence: Evidence
    image_size: tuple[int, int]
    prior: Floats
    free: Flags
    click_noise: Floats
    drawn_noise: Floats
    drawn_loss: float
    where: str = "clicked markings"
    lens: LensCalibration | None = None

    @property
    def half_diagonal(self) -> float:
        """Half the image diagonal [px]."""
        return 0.5 * float(np.hypot(*self.image_size))

    def select(self, points: Flags, markings: Flags) -> Problem:
        """Return the problem restricted to some clicked points (n,) and drawn markings (m,)."""
        return replace(
            self,
            evidence=self.evidence.select(points, markings),
            click_noise=self.click_noise[points],
            drawn_noise=self.drawn_noise[markings[self.evidence.drawn_marking]],
        )

    def with_survey_error(self, row: Floats, settings: StaticCalibrationSettings) -> Problem:
        """Return the problem with click noise that includes the survey error before a camera (22,).

        A survey error that is equal along all axes of the world is so along both axes of the image:
        the error in meters times focal length over depth.
        """
        min_depth = 1.0  # [m]; a camera nearer to a clicked point is far from the answer
        depth = self.evidence.points_world @ row[15:18] + row[20]
        meter = np.where(depth > min_depth, row[0] / np.maximum(depth, min_depth), 0.0)
        return replace(
            self, click_noise=np.hypot(settings.click_noise_px, settings.survey_error_m * meter)
        )


class Fits(NamedTuple):
    """Cameras, their costs and information matrices, written by the kernels.

    Attributes:
        rows: (b, 22) cameras, see `worldpose.geometry.projection`: starts, then fitted ones.
        cost: (b,) half the sum of squared, loss-weighted residuals and priors.
        information: (b, 12, 12) inverse covariance of a step from the evidence and the prior.
        evidence_information: (b, 12, 12) contribution of the evidence alone.
    """

    rows: Floats
    cost: Floats
    information: Floats
    evidence_information: Floats


def build_problem(
    evidence: Evidence,
    image_size: tuple[int, int],
    settings: StaticCalibrationSettings,
    where: str = "clicked markings",
    lens: LensCalibration | None = None,
) -> Problem:
    """Return the fit problem of evidence in an image of a width and height [px].

    A lens replaces the prior of focal length, principal point and distortion; `where` is for
    messages.
    """
    width, height = image_size
    known = settings.prior
    radial = {"none": 0, "k1": 1, "k1_k2": 2, "k1_k2_k3": 3}[settings.distortion]
    free = np.ones(len(PARAMETERS), dtype=np.bool_)
    free[9 + radial :] = False
    middle = (0.5 * (width - 1), 0.5 * (height - 1))
    prior = [np.log(known.focal * width), known.log_focal_std]
    prior += [*middle, known.principal_point_std * width, 0.5 * np.hypot(width, height)]
    prior += [known.k1_std, known.k2_std, known.k3_std]
    prior += [np.log(known.height_m), known.log_height_std]
    prior += [np.log(known.distance_m), known.log_distance_std, known.roll_std_rad, 0.5]
    prior += [*known.lens_std, known.k1, 0.0, 0.0]
    if lens is not None:
        reach = (0.5 * np.hypot(width, height) / lens.focal_px) ** 2
        k1, k2, _, _, k3 = lens.distortion
        prior[:2] = [np.log(lens.focal_px), lens.focal_std_px / lens.focal_px]
        prior[2:5] = [*lens.principal_point_px, lens.principal_point_std_px]
        prior[6:9] = [lens.distortion_std] * 3
        prior[15:] = [0.0, 0.0, 0.0, k1 * reach, k2 * reach**2, k3 * reach**3]
    return Problem(
        evidence=evidence,
        image_size=image_size,
        prior=np.array(prior),
        free=free,
        click_noise=np.full(len(evidence.points), settings.click_noise_px),
        drawn_noise=settings.drawn_noise_px
        * np.sqrt(count_neighbors(evidence, settings.drawn_correlation_px)),
        drawn_loss=settings.drawn_loss_scale,
        where=where,
        lens=lens,
    )


def adjust(
    problem: Problem, rows: Floats, *, click_loss: float = np.inf, iterations: int = _ITERATIONS
) -> Fits:
    """Return cameras fitted from starts (b, 22) in so many iterations at most; 0 only evaluates.

    The loss of clicks is a Cauchy scale [standard deviations]; infinite = least squares.
    """
    count, evidence = len(rows), problem.evidence
    starts = rows.copy()
    if problem.lens is not None:
        starts[:, 6:8] = problem.lens.distortion[2:4]  # tangential terms, which no fit changes
    found = Fits(
        rows=starts,
        cost=np.empty(count),
        information=np.empty((count, SIZE, SIZE)),
        evidence_information=np.empty((count, SIZE, SIZE)),
    )
    given = Measurements(
        points_world=evidence.points_world,
        points_image=evidence.points_image,
        samples_world=evidence.samples_world,
        bounds=evidence.bounds,
        drawn_image=evidence.drawn_image,
        drawn_marking=evidence.drawn_marking,
        prior=problem.prior,
        free=problem.free,
        click_noise=problem.click_noise,
        drawn_noise=problem.drawn_noise,
        half_diagonal=problem.half_diagonal,
        click_loss=float(click_loss),
        drawn_loss=float(problem.drawn_loss),
    )
    descend(given, iterations, found)
    return found


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of clicks and drawn pixels at a camera, and their derivatives by a step [px].

    Attributes:
        click: (n, 2) projected minus clicked.
        by_click: (n, 2, 12).
        drawn: (d,) distances to the projected marking.
        by_drawn: (d, 12).
    """

    click: Floats
    by_click: Floats
    drawn: Floats
    by_drawn: Floats


def compute_residuals(problem: Problem, row: Floats) -> Residuals:
    """Return all residuals at a camera (22,); derivatives by fixed parameters are zero."""
    evidence = problem.evidence
    n, d = len(evidence.points), len(evidence.drawn_image)
    found = Residuals(np.empty((n, 2)), np.empty((n, 2, SIZE)), np.empty(d), np.empty((d, SIZE)))
    point_residuals(row, evidence.points_world, evidence.points_image, found.click, found.by_click)
    drawn_residuals(
        row,
        problem.half_diagonal,
        evidence.samples_world,
        evidence.bounds,
        evidence.drawn_image,
        evidence.drawn_marking,
        found.drawn,
        found.by_drawn,
    )
    return replace(
        found, by_click=found.by_click * problem.free, by_drawn=found.by_drawn * problem.free
    )


def camera_row(camera: Camera) -> Floats:
    """Return the (22,) row of a single camera; the solver checks lens folds itself."""
    pose = camera.cam_from_world
    return np.concatenate(
        [
            camera.focal,
            camera.principal_point,
            camera.distortion,
            pose.rotation.ravel(),
            pose.translation,
            [np.inf],
        ]
    )


def camera_from_row(row: Floats, image_size: tuple[int, int]) -> Camera:
    """Return the camera of a row."""
    u, _, v = np.linalg.svd(row[9:18].reshape(3, 3))
    return Camera(
        focal=row[:2],
        principal_point=row[2:4],
        distortion=row[4:9],
        cam_from_world=Rigid(u @ v, row[18:21]),
        image_size=np.array(image_size),
    )


class Measurements(NamedTuple):
    """Clicks, drawn markings and prior of a camera fit; see `Evidence` and `Problem`."""

    points_world: Floats
    points_image: Floats
    samples_world: Floats
    bounds: Integers
    drawn_image: Floats
    drawn_marking: Integers
    prior: Floats
    free: Flags
    click_noise: Floats
    drawn_noise: Floats
    half_diagonal: float
    click_loss: float
    drawn_loss: float


@compile_kernel
def descend(given: Measurements, iterations: int, found: Fits) -> None:
    """Minimize the cost from each row of `found` in place; see `adjust`."""
    rows, cost, information = found.rows, found.cost, found.information
    free = given.free
    trial = np.empty(22)
    system = np.empty((SIZE, SIZE))
    gradient = np.empty(SIZE)
    new, observed, slope = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty(SIZE)
    step = np.empty(SIZE)
    for b in range(len(rows)):
        trial[:] = rows[b]
        cost[b] = np.inf
        damping = 1e-3
        stalled = 0
        iteration = 0
        while True:
            reached = _linearize(trial, given, new, observed, slope)
            if reached < cost[b] or iteration == 0:
                stalled = stalled + 1 if cost[b] - reached < TOLERANCE * cost[b] else 0
                rows[b] = trial
                cost[b] = reached
                information[b] = new
                found.evidence_information[b] = observed
                gradient[:] = slope
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
def _linearize(
    c: Floats, given: Measurements, information: Floats, observed: Floats, gradient: Floats
) -> float:
    """Return the cost at a camera; write the information with and without priors, and the gradient.

    They are zero for fixed parameters.
    """
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
