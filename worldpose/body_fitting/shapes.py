"""Shapes of all persons with the detector's offsets, which many frames share.

Each can compensate for the other: taller people, or a detector that sees all ankles too high. So no
term may push along that direction frame by frame, because such terms add up while the two priors do
not. Three terms would: a pose prior, whose unbent limbs have to be longer; noise, which lengthens
bones; and a clip of many minutes, whose errors are less independent than its frames. So the pose
prior has almost no weight while shapes are estimated, limbs are shortened by the contribution of
noise, and only some seconds of each person are used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body_fitting.bones import Shape, fit_shape, measure_bones, shorten_limbs
from worldpose.body_fitting.evidence import MIRRORED_OFFSETS, PersonEvidence
from worldpose.body_fitting.pose_space import interpolate_gaps, start_poses
from worldpose.body_fitting.poses import PoseSolver, factor
from worldpose.body_fitting.residuals import (
    NormalEquations,
    PersonObjective,
    Pose,
    offset_term,
    shape_term,
)
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.compiled import map_in_threads

Joints = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Betas and offsets of one clip."""

    people: dict[int, Shape]
    offsets: Floats
    """(17, 3) [m] forward, left and up: from a body's joints to the detector's."""
    offsets_covariance: Floats
    """(17, 3, 3) [m^2]."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Intervals of a person's track, with their current bodies."""

    person: int
    objective: PersonObjective
    pose: Pose


def fit_shapes(
    solver: PoseSolver,
    people: Mapping[int, Sequence[Joints]],
    known: Mapping[int, Shape],
    fps: float,
) -> Shapes:
    """Return betas and the detector's offsets of people with triangulated joints.

    Joints (frames, 17, 3) [m] have a covariance (frames, 17, 3, 3) [m^2], in intervals as
    `spread_intervals` chooses. Persons without a known shape, from other clips, start from the
    prior.
    """

    def sample(person: int) -> Piece | None:
        return _sample_piece(solver, person, people[person], fps)

    pieces = [piece for piece in map_in_threads(sample, people) if piece is not None]
    return solve_shapes(solver, people, pieces, known)


def solve_shapes(
    solver: PoseSolver, people: Iterable[int], pieces: Sequence[Piece], known: Mapping[int, Shape]
) -> Shapes:
    """Return all persons' betas and the detector's offsets, by Gauss-Newton over poses as well."""
    settings, count = solver.settings, solver.chained.model.shapes
    prior_shape = Shape(np.zeros(count), np.eye(count) / settings.shape_weight)
    prior_shapes = {person: known.get(person, prior_shape) for person in people}
    found = dict(prior_shapes)
    unknowns = np.zeros(MIRRORED_OFFSETS.shape[-1])
    spread = settings.bias_std_m**2 * np.eye(len(unknowns))
    expected = settings.bias_std_m**2
    # A posterior of limited precision (Miller and Dunson 2019): errors of the model push the same
    # way in the frames of all persons.
    seconds = sum(len(piece.pose.transl) / piece.objective.fps for piece in pieces)
    prior_weight = max(1.0, seconds / settings.bias_time_s)
    # Weight of `bias_std_m` as a prior, in squared offsets [1]; a clip has 26 offsets.
    bias_prior_weight = 200.0
    for step in range(settings.shape_steps if pieces else 0):
        if solver.ground is not None and step == settings.shape_steps // 2:
            pieces = [
                replace(p, objective=solver.find_standing_ankles(p.objective, p.pose))
                for p in pieces
            ]
        solutions, corners, gradients = _eliminate_poses(
            pieces, prior_shapes, MIRRORED_OFFSETS @ unknowns
        )
        offsets = offset_term(unknowns, expected, prior_weight)
        matrix, right = offsets.matrix, offsets.gradient
        inverses, by_offsets = {}, {}
        for person, corner in corners.items():
            inverses[person] = np.linalg.inv(corner[:count, :count])
            by_offsets[person] = inverses[person] @ corner[:count, count:]
            matrix = matrix + corner[count:, count:] - corner[count:, :count] @ by_offsets[person]
            right = (
                right + gradients[person][count:] - by_offsets[person].T @ gradients[person][:count]
            )
        spread = np.linalg.inv(matrix).astype(np.float64)
        change = -spread @ right
        unknowns = unknowns + change
        # Learn the spread of offsets together with the offsets (expectation-maximisation).
        if step >= settings.shape_steps // 2:
            size = float(unknowns @ unknowns + np.trace(spread))
            prior = bias_prior_weight * settings.bias_std_m**2
            expected = (size + prior) / (len(unknowns) + bias_prior_weight)
        betas_change = {
            # Large steps of the first, roughest linearisation leave the range of human shapes.
            person: np.clip(
                -inverses[person] @ slope[:count] - by_offsets[person] @ change, -1.0, 1.0
            )
            for person, slope in gradients.items()
        }
        pieces = [
            _move_poses(piece, solved, betas_change[piece.person], change)
            for piece, solved in zip(pieces, solutions, strict=True)
        ]
        for piece in pieces:
            by_offset = by_offsets[piece.person]
            covariance = inverses[piece.person] + by_offset @ spread @ by_offset.T
            found[piece.person] = Shape(piece.pose.betas, covariance)
    by_joint = np.einsum("jau,uv,jbv->jab", MIRRORED_OFFSETS, spread, MIRRORED_OFFSETS)
    return Shapes(found, MIRRORED_OFFSETS @ unknowns, by_joint)


def _move_poses(piece: Piece, solved: Floats, betas_change: Floats, change: Floats) -> Piece:
    """Return a piece whose poses follow the steps of its person's betas and of the offsets."""
    pose_step = -solved[..., -1] - solved[..., :-1] @ np.concatenate([betas_change, change])
    return replace(piece, pose=piece.pose.apply_step(pose_step, betas_change))


def _eliminate_poses(
    pieces: Sequence[Piece], priors: Mapping[int, Shape], offsets: Floats
) -> tuple[list[Floats], dict[int, Floats], dict[int, Floats]]:
    """Return the reduced normal equations of each person's betas with the shared offsets."""
    shared = MIRRORED_OFFSETS.shape[-1]
    matrices, gradients = {}, {}
    for person, shape in priors.items():
        count = len(shape.betas)
        own = np.linalg.inv(shape.covariance).astype(np.float64)
        matrices[person] = np.zeros((count + shared,) * 2)
        matrices[person][:count, :count] = own
        gradients[person] = np.zeros(count + shared)
        betas = next((p.pose.betas for p in pieces if p.person == person), shape.betas)
        gradients[person][:count] = shape_term(betas, shape.betas, own).gradient

    def eliminate(piece: Piece) -> tuple[NormalEquations, Floats]:
        equations = piece.objective.equations(piece.pose, offsets, bordered=True)
        sides = np.concatenate([equations.border, equations.gradient[..., None]], axis=-1)
        return equations, factor(equations.blocks).solve(sides)

    solutions = []
    for piece, (equations, solution) in zip(pieces, map_in_threads(eliminate, pieces), strict=True):
        flat = equations.border.reshape(-1, len(equations.corner)).T
        reduced = flat @ solution.reshape(flat.shape[1], -1)
        matrices[piece.person] += equations.corner - reduced[:, :-1]
        gradients[piece.person] += equations.border_gradient - reduced[:, -1]
        solutions.append(solution)
    return solutions, matrices, gradients


def _sample_piece(
    solver: PoseSolver, person: int, intervals: Sequence[Joints], fps: float
) -> Piece | None:
    """Return intervals of a person's track for shape estimation, with initial bodies.

    All in one: the equations of ten short tracks take several times as long as those of one.
    """
    settings, model = solver.settings, solver.chained.model
    stride = max(1, int(fps / settings.shape_rate_hz))
    rate = fps / stride
    joints, covariance = (np.concatenate(column) for column in zip(*intervals, strict=True))
    bones = measure_bones(joints, covariance, settings.repeated(fps))
    betas = fit_shape(model, bones).betas
    sampled = [(some[::stride], sure[::stride]) for some, sure in intervals]
    seen = [
        each
        for each in sampled
        if (np.isfinite(each[0]).all(-1) & np.isfinite(each[1]).all((-1, -2))).any()
    ]
    if not seen:
        return None
    joints, covariance = (np.concatenate(column) for column in zip(*seen, strict=True))
    joints = shorten_limbs(joints, covariance)
    starts = np.cumsum([len(some) for some, _ in seen])[:-1].tolist()
    parts = [interpolate_gaps(part) for part in np.split(joints, starts)]
    if all(np.isfinite(part).all() for part in parts):
        parts = [np.concatenate(parts)]  # for a few frames each, calls take longer than numbers
    poses = [start_poses(model, betas, part, solver.prior) for part in parts]
    objective = PersonObjective(
        solver.chained,
        PersonEvidence.of(joints, covariance, rate, settings),
        solver.prior,
        settings,
        rate,
        settings.shape_acceleration_m_s2,
        settings.shape_pose_weight,
        starts=tuple(starts),
    )
    transl, orient, angles = (np.concatenate(column) for column in zip(*poses, strict=True))
    return Piece(person, objective, Pose(transl, orient, angles, betas))


def spread_intervals(frames: int, fps: float, settings: BodyFittingSettings) -> list[slice]:
    """Return evenly spread intervals of `frames`, `shape_time_s` in total; all frames if fewer."""
    if frames <= settings.shape_time_s * fps:
        return [slice(0, frames)]
    piece_s = 1.0  # Length of the intervals sampled from long tracks [s].
    length = max(3, round(piece_s * fps))
    count = max(1, round(settings.shape_time_s / piece_s))
    starts = np.linspace(0, frames - length, count).astype(np.int64)
    return [slice(int(start), int(start) + length) for start in starts]
