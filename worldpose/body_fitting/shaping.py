"""Shape of every person, estimated together with the detector's systematic offsets (S1).

Many frames share both, and each can compensate for the other: taller people, or a detector that
sees all ankles too high. So no term may push along that direction frame by frame, because pushes
add up while the two priors do not. Three terms would: a pose prior, whose unbent limbs have to be
longer; noise, which lengthens bones; and a clip of many minutes, whose errors are less independent
than its frames. So the prior has almost no weight here, limbs are shortened by the contribution of
noise, and only some seconds of each person are used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body_fitting.bones import Shape, fit_shape, measure_bones, shorten_limbs
from worldpose.body_fitting.evidence import DIFFICULTY, Evidence
from worldpose.body_fitting.objective import Pose, Track
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shared_bias import MIRRORED_OFFSETS
from worldpose.body_fitting.solving import Solver, factor
from worldpose.body_fitting.starting import bridged, start_poses

Joints = tuple[Floats, Floats]

PIECE: Final = 1.0
"""Length of the intervals sampled from long tracks [s]."""
BIAS_WITNESSES: Final = 8.0
"""Weight of `bias_spread` as a prior, in squared offsets [1]."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Betas and offsets of one clip."""

    people: dict[int, Shape]
    offsets: Floats
    """(17, 3) [m] forward, left and up: from a body's joints to the detector's."""
    offsets_covariance: Floats
    """(17, 3, 3) [m^2]."""


@dataclass(frozen=True, eq=False)
class _Piece:
    """An interval of a person's track, with its current bodies."""

    person: int
    track: Track
    pose: Pose


def fit_shapes(
    solver: Solver, people: Mapping[int, Joints], known: Mapping[int, Shape], fps: float
) -> Shapes:
    """Return all persons' betas and the detector's offsets, by Gauss-Newton over poses as well.

    Args:
        solver: body, prior, settings and ground.
        people: joints (frames, 17, 3) [m] and covariance (frames, 17, 3, 3) [m^2] of each.
        known: shapes of some persons from other clips; the others start from the prior.
        fps: [1/s].
    """
    settings, count = solver.settings, solver.chained.model.shapes
    anybody = Shape(np.zeros(count), np.eye(count) / settings.shape_weight)
    believed = {person: known.get(person, anybody) for person in people}
    pieces = [
        piece
        for person, (joints, covariance) in people.items()
        for piece in _cut(solver, person, joints, covariance, fps)
    ]
    found = dict(believed)
    unknowns = np.zeros(MIRRORED_OFFSETS.shape[-1])
    spread = settings.bias_spread**2 * np.eye(len(unknowns))
    expected = settings.bias_spread**2
    # A posterior of limited precision (Miller and Dunson 2019): errors of the model push the same
    # way in the frames of all persons.
    seconds = sum(len(piece.pose.transl) / piece.track.fps for piece in pieces)
    firmness = max(1.0, seconds / settings.bias_time)
    for step in range(settings.shape_steps if pieces else 0):
        if solver.ground is not None and step == settings.shape_steps // 2:
            pieces = [replace(p, track=solver.standing(p.track, p.pose)) for p in pieces]
        offsets = MIRRORED_OFFSETS @ unknowns
        inner, corners, pulls = [], {}, {}
        for person, shape in believed.items():
            own = np.linalg.inv(shape.covariance)
            corners[person] = np.zeros((count + len(unknowns),) * 2)
            corners[person][:count, :count] = own
            pulls[person] = np.zeros(count + len(unknowns))
            betas = next((p.pose.betas for p in pieces if p.person == person), shape.betas)
            pulls[person][:count] = own @ (betas - shape.betas)
        for piece in pieces:
            equations = piece.track.equations(piece.pose, offsets, bordered=True)
            sides = np.concatenate([equations.border, equations.gradient[..., None]], axis=-1)
            inner.append(factor(equations.blocks).solve(sides))
            flat = equations.border.reshape(-1, len(equations.corner)).T
            reduced = flat @ inner[-1].reshape(flat.shape[1], -1)
            corners[piece.person] += equations.corner - reduced[:, :-1]
            pulls[piece.person] += equations.border_gradient - reduced[:, -1]
        matrix = firmness / expected * np.eye(len(unknowns))
        right = matrix @ unknowns
        inverses, ways = {}, {}
        for person, corner in corners.items():
            inverses[person] = np.linalg.inv(corner[:count, :count])
            ways[person] = inverses[person] @ corner[:count, count:]
            matrix = matrix + corner[count:, count:] - corner[count:, :count] @ ways[person]
            right = right + pulls[person][count:] - ways[person].T @ pulls[person][:count]
        spread = np.linalg.inv(matrix).astype(np.float64)
        change = -spread @ right
        unknowns = unknowns + change
        # Learn the spread of offsets together with the offsets (expectation-maximisation).
        if step >= settings.shape_steps // 2:
            size = float(unknowns @ unknowns + np.trace(spread))
            prior = BIAS_WITNESSES * settings.bias_spread**2
            expected = (size + prior) / (len(unknowns) + BIAS_WITNESSES)
        betas_change = {
            # Large steps of the first, roughest linearisation leave the range of human shapes.
            person: np.clip(-inverses[person] @ pull[:count] - ways[person] @ change, -1.0, 1.0)
            for person, pull in pulls.items()
        }
        moved = []
        for piece, solved in zip(pieces, inner, strict=True):
            shared = np.concatenate([betas_change[piece.person], change])
            pose_step = -solved[..., -1] - solved[..., :-1] @ shared
            moved.append(
                replace(piece, pose=piece.pose.moved(pose_step, betas_change[piece.person]))
            )
        pieces = moved
        for piece in pieces:
            way = ways[piece.person]
            covariance = inverses[piece.person] + way @ spread @ way.T
            found[piece.person] = Shape(piece.pose.betas, covariance)
    by_joint = np.einsum("jau,uv,jbv->jab", MIRRORED_OFFSETS, spread, MIRRORED_OFFSETS)
    return Shapes(found, MIRRORED_OFFSETS @ unknowns, by_joint)


def _cut(
    solver: Solver, person: int, joints: Floats, covariance: Floats, fps: float
) -> list[_Piece]:
    """Return intervals of a person's track for shape estimation, with initial bodies."""
    settings, model = solver.settings, solver.chained.model
    stride = max(1, int(fps / settings.shape_rate))
    rate = fps / stride
    scale = (settings.noise_scale * DIFFICULTY[:, None, None]) ** 2
    bones = measure_bones(joints, scale * covariance, 1.0 + settings.noise_time * fps)
    betas = fit_shape(model, bones).betas
    pieces = []
    for part in _parts(len(joints), fps, settings):
        some, sure = joints[part][::stride], covariance[part][::stride]
        if not (np.isfinite(some).all(-1) & np.isfinite(sure).all((-1, -2))).any():
            continue
        some = shorten_limbs(some, scale * sure)
        track = Track(
            solver.chained,
            Evidence.of(some, sure, rate, settings),
            solver.prior,
            settings,
            rate,
            settings.shape_acceleration,
            settings.shape_pose_weight,
        )
        pose = Pose(*start_poses(model, betas, bridged(some), solver.prior), betas)
        pieces.append(_Piece(person, track, pose))
    return pieces


def _parts(frames: int, fps: float, settings: BodyFittingSettings) -> list[slice]:
    """Return evenly spread intervals of `frames`, `shape_time` in total; all frames if fewer."""
    if frames <= settings.shape_time * fps:
        return [slice(0, frames)]
    length = max(3, round(PIECE * fps))
    count = max(1, round(settings.shape_time / PIECE))
    starts = np.linspace(0, frames - length, count).astype(np.int64)
    return [slice(int(start), int(start) + length) for start in starts]
