"""Least squares over tracks: poses of all frames (S3), and shapes with shared offsets (S1).

Many frames share a person's shape and the detector's systematic offsets, and each can compensate
for the other: taller people, or a detector that sees all ankles too high. So no term may push along
that direction frame by frame, because such terms add up while the two priors do not. Three terms
would: a pose prior, whose unbent limbs have to be longer; noise, which lengthens bones; and a clip
of many minutes, whose errors are less independent than its frames. So the pose prior has almost no
weight while shapes are estimated, limbs are shortened by the contribution of noise, and only some
seconds of each person are used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.model import BODY_POSE, BodyModel, BodyParameters
from worldpose.body_fitting.bones import Shape, fit_shape, measure_bones, shorten_limbs
from worldpose.body_fitting.monocular import MonocularPrior
from worldpose.body_fitting.objective import (
    ACCELERATION_SCALE,
    JOINT_SPREAD,
    MIRRORED_OFFSETS,
    Evidence,
    Ground,
    NormalEquations,
    Pose,
    Track,
    ankle_height,
    body_axes,
    find_contacts,
)
from worldpose.body_fitting.point_equations import propagate
from worldpose.body_fitting.pose_space import (
    PosePrior,
    interpolate_gaps,
    level_feet,
    start_poses,
)
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.compiled import map_in_threads
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.geometry.rigid import Rigid

ACCELERATION_WEIGHT: Final = float((1.0 / ACCELERATION_SCALE**2).sum())
"""Number of hip accelerations that equal independent accelerations of all keypoints [1]. But a body
accelerates as one: the search may count them all, the covariance of its poses may not."""


@dataclass(frozen=True, eq=False)
class Solver:
    """Solver of poses, shared by the fits of all persons."""

    chained: ChainedKeypoints
    prior: PosePrior
    settings: BodyFittingSettings
    ground: Ground | None

    def solve_poses(
        self,
        evidence: Evidence,
        shape: Shape,
        offsets: Floats,
        fps: float,
        monocular_prior: MonocularPrior | None = None,
    ) -> tuple[Pose, Track]:
        """Return one person's poses in all frames, and the track with its standing ankles.

        With `monocular_prior` there are two searches. One starts from the monocular poses, and the
        result of lower cost counts: steps from an interpolated start do not reach a body that
        turned unseen, and the cost of a start says little about the cost of its result.
        """
        settings, model = self.settings, self.chained.model
        track = Track(
            self.chained,
            evidence,
            self.prior,
            settings,
            fps,
            settings.acceleration_m_s2,
            settings.pose_weight(fps),
            monocular_prior=monocular_prior,
        )
        target = interpolate_gaps(evidence.joints[:, :17])
        with np.errstate(invalid="ignore"):
            axes = body_axes(target)
        moved = target - np.einsum("fab,jb->fja", axes, offsets)
        target = np.where(np.isfinite(moved), moved, target)
        pose = Pose(*start_poses(model, shape.betas, target, self.prior), shape.betas)
        searched = self.search(track, pose, offsets)
        if monocular_prior is not None:
            guided = self.search(track, start_from_monocular(pose, monocular_prior), offsets)
            # Compare the same terms: each search has its own standing ankles.
            costs = [
                track.equations(p, offsets, bordered=False).cost for p, _ in (searched, guided)
            ]
            searched = guided if costs[1] < costs[0] else searched
        return searched

    def search(self, track: Track, pose: Pose, offsets: Floats) -> tuple[Pose, Track]:
        """Return the pose after Gauss-Newton steps, and the track with standing ankles."""
        for step in range(self.settings.steps):
            if self.ground is not None and step == self.settings.steps // 2:
                track = self.find_standing_ankles(track, pose)
            pose = _take_step(track, pose, offsets)
        return pose, track

    def find_standing_ankles(self, track: Track, pose: Pose) -> Track:
        """Return the track with the ground contacts of its ankles in a pose."""
        assert self.ground is not None
        joints = self.chained.place(pose.parameters())
        height = ankle_height(self.chained.model, pose.betas)
        contacts = find_contacts(
            joints, height, self.ground, track.fps, self.settings, track.starts
        )
        return replace(track, contacts=contacts)

    def plant_feet(self, pose: Pose, seen: NDArray[np.bool_] | None = None) -> BodyParameters:
        """Return the bodies of a pose, with feet that are near the ground turned level with it.

        Args:
            pose: the pose.
            seen: (frames, 2), whether points of the left and right foot determine its pose, which
                then stays; None = neither.
        """
        parameters = pose.parameters()
        if self.ground is None:
            return parameters
        model = self.chained.model
        body = model.articulate(parameters)
        height = ankle_height(model, pose.betas)
        angles = parameters.body_pose.reshape(-1, BODY_POSE // 3, 3).copy()
        for shank, foot in ((4, 7), (5, 8)):
            place = body.joints[:, foot] + parameters.transl
            clear = place[:, 2] - self.ground(place[:, 0], place[:, 1]) - height
            turned = level_feet(body.rotations[:, shank], np.maximum(clear, 0.0))
            level = slice(None) if seen is None else ~seen[:, foot - 7]
            angles[level, foot - 1] = Rigid(turned[level], np.zeros(3)).rotvec
        return replace(parameters, body_pose=angles.reshape(-1, BODY_POSE))


def _take_step(track: Track, pose: Pose, offsets: Floats) -> Pose:
    """Return the pose after one Gauss-Newton step; its equations are gone before the next ones."""
    equations = track.equations(pose, offsets, bordered=False)
    solution = factor(equations.blocks).solve(equations.gradient[..., None])
    return pose.apply_step(-solution[..., 0])


def start_from_monocular(pose: Pose, monocular_prior: MonocularPrior) -> Pose:
    """Return a pose with the monocular poses of the frames where they count.

    Gaps between these, no longer than their errors last, take the pose of the nearest frame: no
    step would remove a jump between poses of two sources.
    """
    frames, used = np.arange(len(monocular_prior.used)), np.flatnonzero(monocular_prior.used)
    before = used[(np.searchsorted(used, frames, side="right") - 1).clip(min=0)]
    after = used[np.searchsorted(used, frames).clip(max=len(used) - 1)]
    inside = (before <= frames) & (frames <= after)
    inside &= after - before <= monocular_prior.correlated_frames
    nearest = np.where(frames - before <= after - frames, before, after)
    known = Rigid(monocular_prior.orient[nearest], np.zeros(3)).rotvec
    # A monocular pose has no coordinates of the feet.
    angles, size = pose.angles.copy(), monocular_prior.angles.shape[1]
    angles[:, :size] = np.where(
        inside[:, None], monocular_prior.angles[nearest], pose.angles[:, :size]
    )
    return replace(pose, orient=np.where(inside[:, None], known, pose.orient), angles=angles)


def damp_motion(track: Track) -> Track:
    """Return a solved track for the covariance of its poses: a body accelerates as one."""
    return replace(
        track,
        acceleration=track.acceleration * ACCELERATION_WEIGHT**0.5,
        contacts=None if track.contacts is None else track.contacts.of(track.evidence.known),
    )


def pose_covariance(track: Track, pose: Pose, offsets: Floats) -> tuple[Floats, Floats]:
    """Return a solved track's points (frames, points, 3) [m] and their covariance.

    The covariance (frames, points, 3, 3) [m^2] is that of the poses.

    Args:
        track: the track, with its standing ankles.
        pose: its poses.
        offsets: (17, 3) [m], the detector's offsets.
    """
    equations = damp_motion(track).equations(pose, offsets, bordered=False)
    inverse = factor(equations.blocks).inverse_blocks()
    return equations.points.keypoints, propagate(equations.points.pose, inverse)


def factor(blocks: Floats) -> BandedFactor:
    """Return the factor of blocks with a little damping, which overwrites the blocks.

    Raises:
        DegenerateError: rounding leaves no positive definite system.
    """
    places = np.arange(blocks.shape[-1])
    blocks[0][:, places, places] *= 1.0 + 1e-4
    # Information of every unknown [1/m^2, 1/rad^2]: 10 m and 10 rad.
    blocks[0][:, places, places] += 0.01
    solved = BandedFactor.of(blocks, overwrite=True)
    if not solved.determined:
        raise DegenerateError(
            "body fitting: the weights of the joints differ by more than double precision can "
            "hold. Give the settings of body_fitting and triangulation values nearer to their "
            "defaults."
        )
    return solved


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
    track: Track
    pose: Pose


def fit_shapes(
    solver: Solver,
    people: Mapping[int, Sequence[Joints]],
    known: Mapping[int, Shape],
    fps: float,
) -> Shapes:
    """Return betas and the detector's offsets of people with triangulated joints.

    Args:
        solver: body, prior, settings and ground.
        people: joints (frames, 17, 3) [m] and covariance (frames, 17, 3, 3) [m^2] of each, in
            intervals as `spread_intervals` chooses.
        known: shapes of some persons from other clips; the others start from the prior.
        fps: [1/s].
    """

    def sample(person: int) -> Piece | None:
        return _sample_piece(solver, person, people[person], fps)

    pieces = [piece for piece in map_in_threads(sample, people) if piece is not None]
    return solve_shapes(solver, people, pieces, known)


def solve_shapes(
    solver: Solver, people: Iterable[int], pieces: Sequence[Piece], known: Mapping[int, Shape]
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
    seconds = sum(len(piece.pose.transl) / piece.track.fps for piece in pieces)
    prior_weight = max(1.0, seconds / settings.bias_time_s)
    # Weight of `bias_std_m` as a prior, in squared offsets [1]; a clip has 26 offsets.
    bias_prior_weight = 200.0
    for step in range(settings.shape_steps if pieces else 0):
        if solver.ground is not None and step == settings.shape_steps // 2:
            pieces = [
                replace(p, track=solver.find_standing_ankles(p.track, p.pose)) for p in pieces
            ]
        solutions, corners, gradients = _eliminate_poses(
            pieces, prior_shapes, MIRRORED_OFFSETS @ unknowns
        )
        matrix = prior_weight / expected * np.eye(len(unknowns))
        right = matrix @ unknowns
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
        moved = []
        for piece, solved in zip(pieces, solutions, strict=True):
            shared = np.concatenate([betas_change[piece.person], change])
            pose_step = -solved[..., -1] - solved[..., :-1] @ shared
            moved.append(
                replace(piece, pose=piece.pose.apply_step(pose_step, betas_change[piece.person]))
            )
        pieces = moved
        for piece in pieces:
            by_offset = by_offsets[piece.person]
            covariance = inverses[piece.person] + by_offset @ spread @ by_offset.T
            found[piece.person] = Shape(piece.pose.betas, covariance)
    by_joint = np.einsum("jau,uv,jbv->jab", MIRRORED_OFFSETS, spread, MIRRORED_OFFSETS)
    return Shapes(found, MIRRORED_OFFSETS @ unknowns, by_joint)


def _eliminate_poses(
    pieces: Sequence[Piece], priors: Mapping[int, Shape], offsets: Floats
) -> tuple[list[Floats], dict[int, Floats], dict[int, Floats]]:
    """Return the reduced normal equations of each person's betas with the shared offsets."""
    shared = MIRRORED_OFFSETS.shape[-1]
    matrices, gradients = {}, {}
    for person, shape in priors.items():
        count = len(shape.betas)
        own = np.linalg.inv(shape.covariance)
        matrices[person] = np.zeros((count + shared,) * 2)
        matrices[person][:count, :count] = own
        gradients[person] = np.zeros(count + shared)
        betas = next((p.pose.betas for p in pieces if p.person == person), shape.betas)
        gradients[person][:count] = own @ (betas - shape.betas)

    def eliminate(piece: Piece) -> tuple[NormalEquations, Floats]:
        equations = piece.track.equations(piece.pose, offsets, bordered=True)
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
    solver: Solver, person: int, intervals: Sequence[Joints], fps: float
) -> Piece | None:
    """Return intervals of a person's track for shape estimation, with initial bodies.

    All in one: the equations of ten short tracks take several times as long as those of one.
    """
    settings, model = solver.settings, solver.chained.model
    stride = max(1, int(fps / settings.shape_rate_hz))
    rate = fps / stride
    scale = (settings.noise_scale * JOINT_SPREAD[:, None, None]) ** 2
    joints, covariance = (np.concatenate(column) for column in zip(*intervals, strict=True))
    bones = measure_bones(joints, scale * covariance, 1.0 + settings.noise_time_s * fps)
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
    joints = shorten_limbs(joints, scale * covariance)
    starts = np.cumsum([len(some) for some, _ in seen])[:-1].tolist()
    parts = [interpolate_gaps(part) for part in np.split(joints, starts)]
    if all(np.isfinite(part).all() for part in parts):
        parts = [np.concatenate(parts)]  # for a few frames each, calls take longer than numbers
    poses = [start_poses(model, betas, part, solver.prior) for part in parts]
    track = Track(
        solver.chained,
        Evidence.of(joints, covariance, rate, settings),
        solver.prior,
        settings,
        rate,
        settings.shape_acceleration_m_s2,
        settings.shape_pose_weight,
        starts=tuple(starts),
    )
    transl, orient, angles = (np.concatenate(column) for column in zip(*poses, strict=True))
    return Piece(person, track, Pose(transl, orient, angles, betas))


def spread_intervals(frames: int, fps: float, settings: BodyFittingSettings) -> list[slice]:
    """Return evenly spread intervals of `frames`, `shape_time_s` in total; all frames if fewer."""
    if frames <= settings.shape_time_s * fps:
        return [slice(0, frames)]
    piece_s = 1.0  # Length of the intervals sampled from long tracks [s].
    length = max(3, round(piece_s * fps))
    count = max(1, round(settings.shape_time_s / piece_s))
    starts = np.linspace(0, frames - length, count).astype(np.int64)
    return [slice(int(start), int(start) + length) for start in starts]


@dataclass(frozen=True, eq=False)
class FittedArrays:
    """Arrays of a fit in progress."""

    betas: Floats
    orient: Floats
    body_pose: Floats
    transl: Floats
    betas_covariance: Floats
    joints: Floats
    covariance: Floats
    filled: NDArray[np.bool_]
    guided: NDArray[np.bool_]

    @classmethod
    def empty(cls, model: BodyModel, frames: int, persons: int) -> FittedArrays:
        """Return arrays without any body."""

        def nan(*shape: int) -> Floats:
            return np.full(shape, np.nan)

        return cls(
            nan(persons, model.shapes),
            nan(frames, persons, 3),
            nan(frames, persons, BODY_POSE),
            nan(frames, persons, 3),
            nan(persons, model.shapes, model.shapes),
            nan(frames, persons, 17, 3),
            nan(frames, persons, 17, 3, 3),
            np.zeros((frames, persons), dtype=bool),
            np.zeros((frames, persons), dtype=bool),
        )

    def put(
        self,
        solver: Solver,
        person: int,
        span: slice,
        pose: Pose,
        joints: tuple[Floats, Floats],
        shapes: Shapes,
        determined: NDArray[np.bool_] | None = None,
    ) -> BodyParameters:
        """Write the result of one person, and return the bodies with their feet.

        `joints` are the keypoints (frames, 17, 3) [m] and their covariance (frames, 17, 3, 3)
        [m^2]; `determined` is as `seen` of `Solver.plant_feet`.

        The covariance of the detector's offsets and of the person's own is added.
        """
        shape = shapes.people[person]
        keypoints, covariance = joints
        bodies = solver.plant_feet(pose, determined)
        self.betas[person] = shape.betas
        self.betas_covariance[person] = shape.covariance
        self.orient[span, person] = bodies.global_orient
        self.body_pose[span, person] = bodies.body_pose
        self.transl[span, person] = bodies.transl
        self.joints[span, person] = keypoints
        axes = body_axes(keypoints)[:, None]
        # A joint is the detector's joint minus the offset: the offset's covariance adds up.
        shared = axes @ shapes.offsets_covariance @ axes.swapaxes(-1, -2)
        own = solver.settings.own_bias_std_m**2 * np.eye(3)
        self.covariance[span, person] = covariance + shared + own
        return bodies

    def drop(self, person: int, span: slice, gone: NDArray[np.bool_]) -> None:
        """Remove a person from frames of a span."""
        for array in (self.orient, self.body_pose, self.transl, self.joints, self.covariance):
            array[span, person][gone] = np.nan
        self.filled[span, person] &= ~gone
        self.guided[span, person] &= ~gone
