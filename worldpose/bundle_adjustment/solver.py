"""Bundle adjustment solver: Levenberg-Marquardt on the reduced camera system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.linalg.blas import dsyrk

from data_contracts.arrays import Floats
from worldpose.bundle_adjustment.residuals import AdjustmentProblem, AdjustmentSolution, prior_cost
from worldpose.bundle_adjustment.settings import SolverSettings
from worldpose.errors import InputError, InternalError
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.geometry.optimize.schur_complement import (
    CameraEquations,
    PointObservations,
    cost,
    eliminate,
    substitute,
)
from worldpose.static_calibration.parameters import step_camera

BLOCK: Final = 256
"""Points eliminated at a time: their rows for 18 cameras (1.3 MB) stay in the cache."""


def solve(
    problem: AdjustmentProblem,
    settings: SolverSettings | None = None,
    offset: Floats | None = None,
    covariance: bool = True,
) -> AdjustmentSolution:
    """Return the cameras and points that fit all observations and priors best.

    `offset` (cameras, 12) are initial steps from the problem's cameras, such as the solution of a
    similar problem; None = none. The cameras' covariance takes as long as half a step. InputError
    if a free point has fewer than two cameras, a point lies behind a camera that sees it, or
    nothing fixes the cameras.
    """
    settings = settings or SolverSettings()
    _require_two_views(problem)
    system = _System(problem)
    points = problem.points
    offset = np.zeros(problem.free.shape) if offset is None else np.where(problem.free, offset, 0.0)
    cameras = step_camera(problem.cameras, offset) if offset.any() else problem.cameras
    start = _State(cameras, points, offset, system.cost(cameras, points, offset))
    if np.isnan(start.cost):
        raise InternalError("bundle adjustment: start", "a cost that is no number")
    if not np.isfinite(start.cost):
        raise InputError(
            "bundle adjustment: start",
            expected="every point in front of the cameras that see it",
            found="points behind a camera, or beyond its lens model",
            todo="Give cameras and points that project near their observations.",
        )
    found = minimize(
        start,
        system.step,
        Damping(start=settings.damping, decrease=5.0, lowest=1e-9),
        settings.max_iterations,
        # A gain below rounding error means convergence, too.
        converged=lambda before, after: (
            abs(before.cost - after.cost) <= settings.min_cost_change * before.cost
        ),
    )
    last = found.state
    spread = system.covariance(last.cameras, last.points) if covariance else np.empty((0, 0))
    return AdjustmentSolution(
        cameras=last.cameras,
        offset=last.offset,
        points=last.points,
        cost=last.cost,
        converged=found.converged,
        camera_covariance=spread,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Cameras and points, with the cameras' steps (cameras, 12) from the start and the cost."""

    cameras: Camera
    points: Floats
    offset: Floats
    cost: float


def _require_two_views(problem: AdjustmentProblem) -> None:
    first = np.searchsorted(problem.point_of, problem.point_of)
    several = np.zeros(len(problem.points), dtype=np.bool_)
    several[problem.point_of[problem.camera_of != problem.camera_of[first]]] = True
    few = np.flatnonzero((problem.point_information == 0.0) & ~several)
    if few.size:
        raise InputError(
            "bundle adjustment: points",
            expected="two cameras or more for every point of unknown place",
            found=f"{few.size} points with fewer, the first is number {few[0]}",
            todo="Leave them out; one view tells no depth.",
        )


class _System:
    """Normal equations of a problem, with points eliminated, and scratch arrays."""

    def __init__(self, problem: AdjustmentProblem) -> None:
        self.names = problem.names
        first_of = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
        self.prior = problem.camera_information
        self.observed = PointObservations(
            problem.points,
            problem.point_information,
            first_of,
            problem.camera_of,
            problem.image,
            problem.weight,
            problem.scale,
        )
        self.free = np.flatnonzero(problem.free.ravel())
        self.columns = np.full(problem.free.shape, -1)
        self.columns.ravel()[self.free] = np.arange(self.free.size)
        self.rows = np.zeros((3 * BLOCK, self.free.size + 1))

    def cost(self, cameras: Camera, points: Floats, offset: Floats) -> float:
        """Return the robust sum of squares with all priors."""
        return cost(cameras.numbers, points, self.observed) + prior_cost(offset, self.prior)

    def step(self, state: _State, damping: float) -> _State:
        """Return the state after a damped step."""
        step, points = self.solve_step(state.cameras, state.points, damping, state.offset)
        cameras, offset = step_camera(state.cameras, step), state.offset + step
        return _State(cameras, points, offset, self.cost(cameras, points, offset))

    def solve_step(
        self, cameras: Camera, points: Floats, damping: float, offset: Floats
    ) -> tuple[Floats, Floats]:
        """Return a damped step of the cameras (cameras, 12), and the points after it."""
        matrix, diagonal, slope = self._assemble(cameras, points, damping)
        matrix[np.diag_indices_from(matrix)] += damping * diagonal
        slope += np.einsum("cij,cj->ci", self.prior, offset).ravel()[self.free]
        step = np.zeros(offset.shape)
        step.ravel()[self.free] = -self._solve(matrix, slope)
        trial = np.empty_like(points)
        substitute(cameras.numbers, points, self.observed, damping, step, trial)
        return step, trial

    def covariance(self, cameras: Camera, points: Floats) -> Floats:
        """Return the inverse of the undamped system, zero for fixed parameters."""
        matrix, _, _ = self._assemble(cameras, points, 0.0)
        covariance = np.zeros((self.columns.size, self.columns.size))
        covariance[np.ix_(self.free, self.free)] = self._solve(matrix, np.eye(self.free.size))
        return covariance

    def _solve(self, matrix: Floats, right: Floats) -> Floats:
        """Return the solution, computed with scaling: units differ by many powers of 10."""
        diagonal = np.diag(matrix)
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            raise InternalError("bundle adjustment", "normal equations that are not finite")
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        scaled = matrix * scale * scale[:, None]
        try:
            factor = cho_factor(scaled, check_finite=False)
        except LinAlgError:
            raise self._singularity_error(scaled) from None
        columns = scale if right.ndim == 1 else scale[:, None]
        return np.asarray(columns * cho_solve(factor, columns * right, check_finite=False))

    def _singularity_error(self, scaled: Floats) -> InputError:
        """Return the error of a singular system, which names the cameras that can move."""
        weakest = np.linalg.eigh(scaled)[1][:, 0]
        share = np.zeros(self.columns.shape)
        share.ravel()[self.free] = weakest**2
        moving = np.flatnonzero(share.sum(axis=1) > 0.1 / len(share))
        if len(moving) == len(share):
            found = "that all of them can move together without any residual"
        else:
            known = self.names or tuple(f"number {index}" for index in range(len(share)))
            listed = ", ".join(known[index] for index in moving)
            found = f"that {listed} can move without any residual"
        return InputError(
            "bundle adjustment",
            expected="cameras that markings or prior knowledge hold in place",
            found=found,
            todo="Add clicked markings of these cameras, or give their calibration.",
        )

    def _assemble(
        self, cameras: Camera, points: Floats, damping: float
    ) -> tuple[Floats, Floats, Floats]:
        """Return reduced matrix, diagonal before the reduction and slope of free parameters."""
        numbers = cameras.numbers
        width = self.free.size
        blocks = np.zeros((len(numbers), STEP, STEP))
        gradient = np.zeros((len(numbers), STEP))
        loss = np.zeros((width + 1, width + 1), order="F")
        for first in range(0, len(points), BLOCK):
            last = min(first + BLOCK, len(points))
            rows = self.rows[: 3 * (last - first)]
            target = CameraEquations(self.columns, rows, blocks, gradient)
            eliminate(numbers, points, self.observed, damping, first, last, target)
            loss = dsyrk(1.0, rows.T, beta=1.0, c=loss, overwrite_c=True)
        lost = loss[:width, :width]
        blocks = np.tril(blocks) + np.tril(blocks, -1).swapaxes(1, 2) + self.prior
        matrix = block_diag(*blocks)[np.ix_(self.free, self.free)]
        diagonal = np.diag(matrix)
        matrix = matrix - (np.triu(lost) + np.triu(lost, 1).T)
        return matrix, diagonal, gradient.ravel()[self.free] - loss[:width, width]
