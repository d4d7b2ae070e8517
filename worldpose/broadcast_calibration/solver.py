"""Joint fit of all frames: Levenberg-Marquardt on an arrow system, or the paper's Adam."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.clip_problem import ClipProblem
from worldpose.broadcast_calibration.evidence import PointEvidence
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, MovingCamera
from worldpose.broadcast_calibration.residuals import ClipEquations, linearize
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.arrow import ArrowFactor, ArrowSystem
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize


@dataclass(frozen=True, eq=False)
class ClipSolution:
    """A camera, and the course of the iterations to it.

    Attributes:
        camera: all frames.
        paint_offsets: (painted, 3) offsets of painted template points from the survey, then of the
            pitch's size, if it is not known [standard deviations].
        equations: equations at this camera.
        costs: cost after every iteration.
    """

    camera: MovingCamera
    paint_offsets: Floats
    equations: ClipEquations
    costs: tuple[float, ...] = ()

    @classmethod
    def at(cls, camera: MovingCamera, paint_offsets: Floats, problem: ClipProblem) -> ClipSolution:
        """Return a camera and paint offsets with their equations."""
        return cls(camera, paint_offsets, linearize(camera, paint_offsets, problem))

    @property
    def cost(self) -> float:
        """Cost of the camera."""
        return self.equations.cost

    def take_step(self, frame: Floats, shared: Floats, problem: ClipProblem) -> ClipSolution:
        """Return the state after a step of the frames (frames, 7) and of shared parameters."""
        paint = self.paint_offsets + shared[CLIP_SIZE:].reshape(self.paint_offsets.shape)
        return ClipSolution.at(self.camera.take_step(frame, shared[:CLIP_SIZE]), paint, problem)


def solve(camera: MovingCamera, problem: ClipProblem, iterations: int) -> ClipSolution:
    """Return the camera of least cost near a start; DegenerateError if the matrix is singular.

    A parameter then has neither evidence nor prior.
    """

    def step(state: ClipSolution, damping: float) -> ClipSolution:
        system = state.equations.system
        frame, shared = factorize(system, damping).solve(
            -system.right[..., None], -system.right_corner[:, None]
        )
        return state.take_step(frame[..., 0], shared[:, 0], problem)

    found = minimize(
        ClipSolution.at(camera, np.zeros((problem.paint_count, 3)), problem),
        step,
        Damping(start=1e-4, decrease=6.0, lowest=1e-10, highest=1e9),
        iterations,
        converged=lambda before, after: 0.0 < before.cost - after.cost < 1e-7 * after.cost,
    )
    return replace(found.state, costs=found.costs)


def factorize(system: ArrowSystem, damping: float = 0.0) -> ArrowFactor:
    """Return the factor of a system; DegenerateError if its matrix is singular."""
    factor = ArrowFactor.of(system, damping)
    if not factor.determined:
        raise DegenerateError(
            "broadcast camera: a frame's parameters have neither evidence nor prior. Pick a key "
            "frame near the frames without lines, or give priors."
        )
    return factor


def displace(points: PointEvidence, problem: ClipProblem, paint_offsets: Floats) -> PointEvidence:
    """Return evidence whose places have the estimated paint errors (painted, 3) and pitch size."""
    padded = np.concatenate([paint_offsets, np.zeros((1, 3))])
    world = points.world + (points.shares[..., None] * padded[problem.ends]).sum(axis=1)
    if problem.size_row >= 0:
        world += (points.by_size * paint_offsets[problem.size_row :]).sum(axis=1)
    return replace(points, world=world)
