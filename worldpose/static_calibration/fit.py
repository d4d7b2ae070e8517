"""Fit of static cameras to clicks, drawn markings and priors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Flags, Floats
from data_contracts.cameras import LensCalibration
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import STEP, step_row
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import WIDTH, LensModel
from worldpose.geometry.optimize.dense import solve_in_place
from worldpose.geometry.optimize.levenberg_marquardt import Damping, is_better, next_damping
from worldpose.static_calibration.evidence import ClickEvidence, count_neighbors
from worldpose.static_calibration.residuals import (
    Measurements,
    click_residuals,
    drawn_residuals,
    linearize,
)
from worldpose.static_calibration.settings import StaticCalibrationSettings

_ITERATIONS: Final = 60
"""Enough from any start in the basin; most end after ten."""
_DAMPING: Final = Damping(start=1e-4, decrease=10.0, lowest=1e-9, highest=1e8)


@dataclass(frozen=True, eq=False)
class CameraProblem:
    """Observations, noise and prior of a camera fit, as the compiled kernels expect them.

    Attributes:
        image_size: width, height [px].
        prior: (21,), see `prior_residuals`.
        free: (12,) parameters to solve for.
        click_noise: (n,) standard deviation of each click, each axis [px].
        drawn_noise: (d,) standard deviation of each drawn pixel, across its marking [px]: larger
            where other pixels are close.
        drawn_loss: Cauchy scale of drawn points [standard deviations].
        where: file or camera, for messages.
        lens: the given lens that `prior` contains; None = none is known.
        lens_model: lens model of the camera, that of a given lens.
    """

    evidence: ClickEvidence
    image_size: tuple[int, int]
    prior: Floats
    free: Flags
    click_noise: Floats
    drawn_noise: Floats
    drawn_loss: float
    where: str = "clicked markings"
    lens: LensCalibration | None = None
    lens_model: LensModel = LensModel.BROWN

    @property
    def half_diagonal(self) -> float:
        """Half the image diagonal [px]."""
        return 0.5 * float(np.hypot(*self.image_size))

    def select(self, points: Flags, markings: Flags) -> CameraProblem:
        """Return the problem restricted to some clicked points (n,) and drawn markings (m,)."""
        return replace(
            self,
            evidence=self.evidence.select(points, markings),
            click_noise=self.click_noise[points],
            drawn_noise=self.drawn_noise[markings[self.evidence.drawn_marking]],
        )

    def with_survey_error(self, row: Floats, settings: StaticCalibrationSettings) -> CameraProblem:
        """Return the problem with click noise that includes the survey error at a camera (WIDTH,).

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
        rows: (b, WIDTH) cameras, see `worldpose.geometry.camera_model`: starts, then fitted ones.
        cost: (b,) half the sum of squared, loss-weighted residuals and priors.
        information: (b, 12, 12) inverse covariance of a step from the evidence and the prior.
        evidence_information: (b, 12, 12) contribution of the evidence alone.
    """

    rows: Floats
    cost: Floats
    information: Floats
    evidence_information: Floats


def build_problem(
    evidence: ClickEvidence,
    image_size: tuple[int, int],
    settings: StaticCalibrationSettings,
    where: str = "clicked markings",
    lens: LensCalibration | None = None,
) -> CameraProblem:
    """Return the fit problem of evidence in an image of a width and height [px].

    A lens replaces the prior of focal length, principal point and distortion; `where` is for
    messages.
    """
    width, height = image_size
    known = settings.prior
    radial = {"none": 0, "k1": 1, "k1_k2": 2, "k1_k2_k3": 3}[settings.distortion]
    free = np.ones(STEP, dtype=np.bool_)
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
        k1, k2, _, _, k3 = Camera.from_lens(lens, image_size).distortion[:5]
        prior[:2] = [np.log(lens.focal_px), lens.focal_std_px / lens.focal_px]
        prior[2:5] = [*lens.principal_point_px, lens.principal_point_std_px]
        prior[6:9] = [lens.distortion_std] * 3
        prior[15:] = [0.0, 0.0, 0.0, k1 * reach, k2 * reach**2, k3 * reach**3]
    return CameraProblem(
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
        lens_model=LensModel.BROWN if lens is None else LensModel.named(lens.lens_model),
    )


def fit_cameras(
    problem: CameraProblem,
    rows: Floats,
    *,
    click_loss: float = np.inf,
    iterations: int = _ITERATIONS,
) -> Fits:
    """Return cameras fitted from starts (b, WIDTH) in so many iterations at most; 0 only evaluates.

    The loss of clicks is a Cauchy scale [standard deviations]; infinite = least squares.
    """
    count, evidence = len(rows), problem.evidence
    starts = _with_model(rows, problem)
    found = Fits(
        rows=starts,
        cost=np.empty(count),
        information=np.empty((count, STEP, STEP)),
        evidence_information=np.empty((count, STEP, STEP)),
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
    _descend(given, iterations, found)
    return found


def _with_model(rows: Floats, problem: CameraProblem) -> Floats:
    """Return cameras (b, WIDTH) with the problem's lens model, and what no fit changes of its lens.

    A fisheye and Brown's lens replace each other up to the fifth power of the angle from the axis.
    """
    rows = rows.copy()
    others = rows[:, 25] != problem.lens_model
    k1, k2 = rows[others, 4], rows[others, 5]
    if problem.lens_model == LensModel.FISHEYE:
        rows[others, 4], rows[others, 5] = k1 + 1.0 / 3.0, k2 + k1 + 2.0 / 15.0
    else:
        rows[others, 4], rows[others, 5] = k1 - 1.0 / 3.0, k2 - k1 + 1.0 / 5.0
    rows[others, 25] = problem.lens_model
    # Columns of p1, p2, k4, k5 and k6, which no fit changes.
    kept_columns = [6, 7, 22, 23, 24]
    if problem.lens is not None:
        known = Camera.from_lens(problem.lens).numbers
        rows[others, 4:9] = known[4:9]
        rows[:, kept_columns] = known[kept_columns]
    return rows


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


def compute_residuals(problem: CameraProblem, row: Floats) -> Residuals:
    """Return all residuals at a camera (WIDTH,); derivatives by fixed parameters are zero."""
    evidence = problem.evidence
    n, d = len(evidence.points), len(evidence.drawn_image)
    found = Residuals(np.empty((n, 2)), np.empty((n, 2, STEP)), np.empty(d), np.empty((d, STEP)))
    click_residuals(row, evidence.points_world, evidence.points_image, found.click, found.by_click)
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


@compile_kernel
def _descend(given: Measurements, iterations: int, found: Fits) -> None:
    """Minimize the objective from each row of `found` in place; see `fit_cameras`."""
    tolerance = 1e-10  # relative decrease of the cost below which the loop counts as converged
    rows, cost, free = found.rows, found.cost, given.free
    trial, step = np.empty(WIDTH), np.empty(STEP)
    system, information, observed = (
        np.empty((STEP, STEP)),
        np.empty((STEP, STEP)),
        np.empty((STEP, STEP)),
    )
    gradient, slope = np.empty(STEP), np.empty(STEP)
    for b in range(len(rows)):
        cost[b] = linearize(
            rows[b], given, found.information[b], found.evidence_information[b], gradient
        )
        damping, stalled = _DAMPING.start, 0
        for _ in range(iterations):
            if stalled == 2 or damping > _DAMPING.highest:
                break
            system[:] = found.information[b]
            for j in range(STEP):
                system[j, j] = system[j, j] * (1.0 + damping) if free[j] else 1.0
                step[j] = -gradient[j]
            reached = np.inf
            if solve_in_place(system, step, 0.0) > 0.0:
                step_row(rows[b], step, trial)
                reached = linearize(trial, given, information, observed, slope)
            accepted = is_better(cost[b], reached)
            damping = next_damping(damping, accepted, _DAMPING)
            if accepted:
                stalled = stalled + 1 if cost[b] - reached < tolerance * cost[b] else 0
                rows[b], cost[b] = trial, reached
                found.information[b], found.evidence_information[b] = information, observed
                gradient[:] = slope
