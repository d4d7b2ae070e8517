"""Joint fit of all frames: Levenberg-Marquardt on a banded arrow system (M3 to M6)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.broadcast_calibration.evidence import FlowEvidence, PointEvidence, bounds
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.normal_equations import (
    Flow,
    NormalEquations,
    add_flow,
    add_points,
    empty_equations,
)
from worldpose.broadcast_calibration.priors import Prior, add_smoothness
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.geometry.optimize.levenberg_marquardt import Schedule, minimize


@dataclass(frozen=True, eq=False)
class Problem:
    """Evidence, smoothness and priors of a clip's fit.

    Attributes:
        points: clicks, lines and players.
        flow: followed points.
        prior: prior of center and lenses.
        smoothness: (7,) standard deviation of second differences of a frame's parameters; infinite
            = free.
        flow_weight: factor on the loss of followed points [1].
        flow_loss: scale of that loss [standard deviations].
        free_frame: (7,) mask of a frame's free parameters.
        free_clip: (5,) mask of the clip's free parameters.
        known: (frames, 7) mask of fixed parameters in single frames, such as the first frame's
            rotation.
    """

    points: PointEvidence
    flow: FlowEvidence
    prior: Prior
    smoothness: Floats = field(default_factory=lambda: np.full(FRAME_SIZE, np.inf))
    flow_weight: float = 1.0
    flow_loss: float = np.inf
    free_frame: Flags = field(default_factory=lambda: np.ones(FRAME_SIZE, np.bool_))
    free_clip: Flags = field(default_factory=lambda: np.ones(CLIP_SIZE, np.bool_))
    known: Flags | None = None

    def fixed_mask(self, frames: int) -> Flags:
        """Return the mask of every frame's fixed parameters (frames, 7)."""
        held = np.broadcast_to(~self.free_frame, (frames, FRAME_SIZE))
        return held if self.known is None else held | self.known

    @cached_property
    def painted(self) -> Integers:
        """Indices of the template points with estimated paint errors, rising (m,)."""
        found = np.unique(self.points.ends)
        return np.asarray(found[found >= 0])

    @cached_property
    def size_row(self) -> int:
        """First of the two last rows of the paint errors, of the pitch's size; -1 if known."""
        return len(self.painted) if self.points.by_size.any() else -1

    @property
    def paint_count(self) -> int:
        """Rows of the paint errors: template points, and the pitch's size."""
        return len(self.painted) + 2 * (self.size_row >= 0)

    def of_size(self, rows: Floats) -> Floats:
        """Return length, width, crown and end fall (4,) of paint errors (paint_count, 3)."""
        if self.size_row < 0:
            return np.zeros(4)
        return np.asarray(rows[self.size_row :].ravel()[np.array([0, 1, 2, 5])])

    @cached_property
    def ends(self) -> Integers:
        """Indices into `painted` of the points that define each evidence (n, 2); -1 = none."""
        number = np.searchsorted(self.painted, self.points.ends)
        return np.asarray(np.where(self.points.ends >= 0, number, -1))


@dataclass(frozen=True, eq=False)
class Equations:
    """Cost, gradient and Gauss-Newton matrix, linearized at one camera estimate.

    Attributes:
        cost: half the sum of losses and squares.
        system: matrix and gradient.
    """

    cost: float
    system: NormalEquations


@dataclass(frozen=True, eq=False)
class Solution:
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
    equations: Equations
    costs: tuple[float, ...] = ()

    @property
    def cost(self) -> float:
        """Cost of the camera."""
        return self.equations.cost


def equations_at(camera: MovingCamera, paint_offsets: Floats, problem: Problem) -> Equations:
    """Return cost, gradient and Gauss-Newton matrix of a problem, linearized at `camera`.

    The paint has offsets (painted, 3) [standard deviations].
    """
    frames = len(camera)
    shared = CLIP_SIZE + paint_offsets.size
    system = empty_equations(frames, shared)
    # Prior of the paint errors, in standard deviations.
    system.corner[range(CLIP_SIZE, shared), range(CLIP_SIZE, shared)] = 1.0
    system.right_corner[CLIP_SIZE:] = paint_offsets.ravel()
    points, flow = problem.points, problem.flow
    edges = bounds(points.frame, frames)
    evidence = points.arrays(problem.ends, problem.size_row)
    cost = add_points(camera.arrays, edges, evidence, paint_offsets, system)
    if len(flow) and problem.flow_weight > 0.0:
        followed = Flow(
            flow.start, flow.end, flow.deviation, problem.flow_weight, problem.flow_loss
        )
        cost += add_flow(camera.arrays, bounds(flow.frame, frames), followed, system)
    cost += 0.5 * float((paint_offsets**2).sum())
    cost += add_smoothness(camera, problem.smoothness, system.blocks, system.right)
    cost += _add_prior(camera, problem.prior, system)
    _remove_fixed(problem, system)
    return Equations(float(cost), system)


def solve(camera: MovingCamera, problem: Problem, iterations: int) -> Solution:
    """Return the camera of least cost near a start.

    Raises:
        DegenerateError: the matrix is singular: a parameter has neither evidence nor prior.
    """

    def step(state: Solution, damping: float) -> Solution:
        frame, shared = _solve_step(state.equations.system, damping)
        camera = state.camera.take_step(frame, shared[:CLIP_SIZE])
        paint_offsets = state.paint_offsets + shared[CLIP_SIZE:].reshape(state.paint_offsets.shape)
        return Solution(camera, paint_offsets, equations_at(camera, paint_offsets, problem))

    paint_offsets = np.zeros((problem.paint_count, 3))
    start = Solution(camera, paint_offsets, equations_at(camera, paint_offsets, problem))
    schedule = Schedule(
        damping=1e-4,
        decrease=6.0,
        min_damping=1e-10,
        max_damping=1e9,
        iterations=iterations,
        converged=lambda before, after: 0.0 < before - after < 1e-7 * after,
    )
    found = minimize(start, step, schedule)
    return replace(found.state, costs=found.costs)


def displace(points: PointEvidence, problem: Problem, paint_offsets: Floats) -> PointEvidence:
    """Return evidence whose places have the estimated paint errors (painted, 3) and pitch size."""
    padded = np.concatenate([paint_offsets, np.zeros((1, 3))])
    world = points.world + (points.shares[..., None] * padded[problem.ends]).sum(axis=1)
    if problem.size_row >= 0:
        world += (points.by_size * paint_offsets[problem.size_row :]).sum(axis=1)
    return replace(points, world=world)


def factorize(blocks: Floats) -> BandedFactor:
    """Return the factors of the frames' blocks (3, frames, 7, 7).

    Raises:
        DegenerateError: the matrix is singular.
    """
    factor = BandedFactor.of(blocks)
    if not factor.determined:
        raise DegenerateError(
            "broadcast camera: a frame's parameters have neither evidence nor prior. Pick a key "
            "frame near the frames without lines, or give priors."
        )
    return factor


def _solve_step(system: NormalEquations, damping: float) -> tuple[Floats, Floats]:
    """Return the damped Gauss-Newton step of the frames (frames, 7) and of shared parameters."""
    blocks = system.blocks.copy()
    blocks[0][:, range(FRAME_SIZE), range(FRAME_SIZE)] *= 1.0 + damping
    factor = factorize(blocks)
    columns = np.concatenate([-system.right[..., None], system.border], axis=-1)
    solved = factor.solve(columns)
    corner = system.corner * (1.0 + damping * np.eye(len(system.corner)))
    product = system.border.reshape(-1, len(corner)).T @ solved.reshape(-1, 1 + len(corner))
    reduced = corner - product[:, 1:]
    rest = -system.right_corner - product[:, 0]
    clip = np.linalg.solve(reduced, rest)
    return solved[..., 0] - solved[..., 1:] @ clip, np.asarray(clip)


def _add_prior(camera: MovingCamera, prior: Prior, system: NormalEquations) -> float:
    """Add the priors and return their cost."""
    blocks, corner = system.blocks, system.corner
    right, right_corner = system.right, system.right_corner
    off = camera.center - prior.center
    corner[:3, :3] += prior.center_information
    right_corner[:3] += prior.center_information @ off
    cost = 0.5 * float(off @ prior.center_information @ off)
    moved = (camera.principal_point - prior.principal_point) / prior.principal_std
    corner[[3, 4], [3, 4]] += 1.0 / prior.principal_std**2
    right_corner[3:CLIP_SIZE] += moved / prior.principal_std
    cost += 0.5 * float(moved @ moved)
    lens = np.concatenate([np.log(camera.focal)[:, None], camera.distortion], axis=1)
    middle = np.concatenate([prior.log_focal[:, None], prior.distortion], axis=1)
    width = np.full((len(lens), 1), prior.log_focal_std)
    spread = np.concatenate([width, prior.distortion_std], axis=1)
    gone = (lens - middle) / spread
    blocks[0][:, range(3, FRAME_SIZE), range(3, FRAME_SIZE)] += 1.0 / spread**2
    right[:, 3:] += gone / spread
    return cost + 0.5 * float((gone**2).sum())


def _remove_fixed(problem: Problem, system: NormalEquations) -> None:
    """Remove fixed parameters from the system, in place."""
    blocks, border, corner = system.blocks, system.border, system.corner
    right, right_corner = system.right, system.right_corner
    fixed = problem.fixed_mask(len(right))
    if fixed.any():
        for below in range(3):
            rows = np.concatenate([fixed[below:], np.zeros((below, FRAME_SIZE), np.bool_)])
            blocks[below][rows[:, :, None] | fixed[:, None, :]] = 0.0
        border[fixed] = 0.0
        right[fixed] = 0.0
        frame, number = np.nonzero(fixed)
        blocks[0, frame, number, number] = 1.0
    held = np.flatnonzero(~problem.free_clip)
    border[:, :, held] = 0.0
    corner[held, :] = corner[:, held] = 0.0
    corner[held, held] = 1.0
    right_corner[held] = 0.0


RATE = 1e-3
"""Learning rate of every parameter [its unit; thousands of pixels for the principal point] (M5)."""


def descend(camera: MovingCamera, problem: Problem, iterations: int) -> Solution:
    """Return the camera after some iterations of Adam (Kingma and Ba) at a rate of 1e-3.

    Parameters are those of the solver: rotations in radians, logarithms of focal lengths,
    distortion, metres. The principal point is in units of 1,000 px.
    """
    decay = (0.9, 0.999)
    frames = len(camera) * FRAME_SIZE
    paint_offsets = np.zeros((problem.paint_count, 3))
    size = frames + CLIP_SIZE + paint_offsets.size
    unit = np.ones(size)
    unit[frames + 3 : frames + CLIP_SIZE] = 1e3
    mean, square = np.zeros(size), np.zeros(size)
    here = equations_at(camera, paint_offsets, problem)
    costs = [here.cost]
    for iteration in range(1, iterations + 1):
        gradient = unit * np.concatenate([here.system.right.ravel(), here.system.right_corner])
        mean = decay[0] * mean + (1.0 - decay[0]) * gradient
        square = decay[1] * square + (1.0 - decay[1]) * gradient**2
        first = mean / (1.0 - decay[0] ** iteration)
        second = square / (1.0 - decay[1] ** iteration)
        step = -RATE * unit * first / (np.sqrt(second) + 1e-8)
        shared = step[frames:]
        camera = camera.take_step(step[:frames].reshape(-1, FRAME_SIZE), shared[:CLIP_SIZE])
        paint_offsets = paint_offsets + shared[CLIP_SIZE:].reshape(paint_offsets.shape)
        here = equations_at(camera, paint_offsets, problem)
        costs.append(here.cost)
    return Solution(camera, paint_offsets, here, tuple(costs))
