"""The objective of body fitting, and its terms with their derivatives.

For one person, with pose theta, position t, shape beta, the detector's offsets o, keypoints
P_tj(theta, t, beta) of the body, and second differences D_tj = P_t+2,j - 2 P_t+1,j + P_tj:

    E_refine = E_data + E_smooth + E_slip + E_contact + E_pose + E_limit + E_monocular
               + E_shape + E_offset

    E_data      = sum_tj rho(r_tj^T W_tj r_tj; loss_scale^2),   r_tj = P_tj + A_t o_j - X_tj
    E_smooth    = min(1, 120 / fps) sum_tj rho(|D_tj|^2 / s_j^2; 3 acceleration_loss_scale^2)
    E_slip      = 1/2 sum |P_t+1,j - P_tj|^2 / slip_std^2       over standing ankles
    E_contact   = 1/2 sum (z_tj - h_tj)^2 / contact_std^2       over standing and sunken ankles
    E_pose      = 1/2 pose_weight sum_t (theta_t - mu)^T Lambda (theta_t - mu)
    E_limit     = 1/2 sum_t |theta_t beyond the joint limits|^2 / limit_std^2
    E_monocular : see `monocular.MonocularPrior`
    E_shape     = 1/2 (beta - beta_0)^T B (beta - beta_0)
    E_offset    = 1/2 n |u|^2 / sigma^2,   o = o(u), mirrored left to right

    rho(e; c) = c / 2 log(1 + e / c), the loss of Cauchy

E_data, E_smooth and E_shape are those of the paper, with these differences. The paper projects P
and compares it with keypoints in the images, relative to the hips. Here X_tj is the triangulated
joint and W_tj the inverse of its covariance, which represents the reprojections of the inlier views
to first order; lines of sight of single cameras are part of W_tj, too. A_t has the axes of the body
as columns. Losses are robust, and the paper's weights lambda_1 to lambda_3 are inverse variances
with units: of the joints, of accelerations s_j fps^2, and of betas (B = shape_weight before other
clips are known). sigma starts as `bias_std_m` and is learned; n grows with the observed time, since
errors of the model are alike in all frames. The poses of all frames are solved with fixed beta and
o (`poses`); beta and o are estimated before, with coarse poses (`shapes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import FEET
from worldpose.body.jacobian import ChainedKeypoints, KeypointJacobian
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.evidence import (
    ANKLES,
    MIRRORED_OFFSETS,
    Contacts,
    PersonEvidence,
    body_axes,
)
from worldpose.body_fitting.monocular import MonocularPrior
from worldpose.body_fitting.point_equations import accumulate_points
from worldpose.body_fitting.pose_space import (
    MAX_ANGLES,
    MIN_ANGLES,
    SIZE,
    SPREADS,
    PosePrior,
    differentiate_points,
)
from worldpose.body_fitting.settings import BodyFittingSettings

UNKNOWNS: Final = 6 + SIZE
"""Unknowns per frame: translation, orientation and angles; more with points of the feet."""
ACCELERATION_SCALE: Final = np.array(
    [1, 1, 1, 1, 1, 1, 1, 2, 2, 3, 3, 1, 1, 5, 5, 5, 5], dtype=np.float64
)
"""Accelerations of joints as multiples of the hips'; averages of simulated players."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Unknowns of a track."""

    transl: Floats
    """(frames, 3) [m]"""
    orient: Floats
    """(frames, 3) [rad]"""
    angles: Floats
    """(frames, 30) [rad], of `pose_space`; (frames, 38) with those of the feet."""
    betas: Floats
    """(shapes,)"""

    def parameters(self) -> BodyParameters:
        """Return the bodies (frames,)."""
        angles = self.angles @ SPREADS[self.angles.shape[1]].T
        return BodyParameters(self.betas, self.orient, angles, self.transl)

    def apply_step(self, step: Floats, betas: Floats | float = 0.0) -> Pose:
        """Return the pose after a step (frames, 36), with rotations clipped to the linear range."""
        # Maximum change of an angle per step [rad]; beyond it the linear model is invalid.
        max_rotation = 0.6
        turns = np.clip(step[:, 3:], -max_rotation, max_rotation)
        orient = self.orient + turns[:, :3]
        angle = np.linalg.norm(orient, axis=-1, keepdims=True)
        # The same rotation by the smaller angle.
        shorter = orient * (1.0 - 2.0 * np.pi / np.maximum(angle, np.pi))
        orient = np.where(angle > np.pi, shorter, orient)
        transl, angles = self.transl + step[:, :3], self.angles + turns[:, 3:]
        return Pose(transl, orient, angles, self.betas + betas)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """`[blocks border; border^T corner] step = -[gradient; border_gradient]` of one track."""

    points: KeypointJacobian
    """Points (frames, points) and their derivatives by the unknowns."""
    blocks: Floats
    """(3, frames, 36, 36), those on the diagonal valid in the lower triangle; (1, frames, 36, 36)
    of frames by themselves."""
    gradient: Floats
    """(frames, 36)"""
    border: Floats
    """(frames, 36, shapes + offsets)"""
    corner: Floats
    """(shapes + offsets, shapes + offsets)"""
    border_gradient: Floats
    """(shapes + offsets,)"""
    cost: float


@dataclass(frozen=True, eq=False)
class PersonObjective:
    """E_refine of one person's track, as a function of the pose."""

    chained: ChainedKeypoints
    evidence: PersonEvidence
    prior: PosePrior
    settings: BodyFittingSettings
    fps: float
    acceleration: float
    """Standard deviation of the hips' acceleration [m/s^2]; infinite for frames by themselves."""
    pose_weight: float
    """Weight of the pose prior in each frame [1]."""
    contacts: Contacts | None = None
    monocular_prior: MonocularPrior | None = None
    starts: tuple[int, ...] = ()
    """First frames of the intervals after the first; motion ties no interval to another."""

    def equations(
        self, pose: Pose, offsets: Floats, *, bordered: bool, points: KeypointJacobian | None = None
    ) -> NormalEquations:
        """Return the normal equations at a pose: of all terms but E_shape and E_offset.

        Offsets (17, 3) [m] forward, left, up, are from a body's joints to the detector's. If
        `bordered`, the equations have a border for betas and offsets. `points` are those of the
        pose with their derivatives, if they are known.
        """
        given, body = self.settings, points or self.differentiate(pose, by_betas=bordered)
        frames, count = body.keypoints.shape[:2]
        # The points besides COCO-17 already lie where the detector has them.
        offsets = np.concatenate([offsets, np.zeros((count - len(offsets), 3))])
        axes = body_axes(body.keypoints)
        perceived = body.keypoints + np.einsum("fab,jb->fja", axes, offsets)

        sums = PointSums.empty(frames, count)
        tied = bool(np.isfinite(self.acceleration)) or self.contacts is not None
        if tied:
            share = given.smooth_weight(self.fps)
            std = self.acceleration * acceleration_scale(count) / self.fps**2 / share**0.5
            tail = 3.0 * given.acceleration_loss_scale**2 * share
            add_smoothness(sums, body.keypoints, std, tail, self.starts)
        if self.contacts is not None:
            add_slip(sums, body.keypoints, self.contacts, given.slip_std_m)
            add_contact(sums, body.keypoints, self.contacts, given.contact_std_m)
        data = add_data(sums, perceived, self.evidence, given.loss_scale)
        blocks, gradient = sums.by_unknowns(body.pose, tied)
        by_pose = pose_term(pose.angles, self.prior, self.pose_weight)
        limits = limit_term(pose.angles, given.limit_std_rad)
        gradient[:, 6:] += by_pose.gradient + limits.gradient
        blocks[0][:, 6:, 6:] += by_pose.matrix
        places = np.arange(6, 6 + pose.angles.shape[1])
        blocks[0][:, places, places] += limits.matrix
        cost = sums.cost + by_pose.cost + limits.cost
        if self.monocular_prior is not None:
            matrix, slope, prior_cost = self.monocular_prior.normal_equations(
                pose.orient, pose.angles[:, :SIZE]
            )
            blocks[0][:, 3:UNKNOWNS, 3:UNKNOWNS] += matrix
            gradient[:, 3:UNKNOWNS] += slope
            cost += prior_cost
        if not bordered:
            border, corner = np.zeros((*gradient.shape, 0)), np.zeros((0, 0))
            return NormalEquations(body, blocks, gradient, border, corner, np.zeros(0), cost)
        return NormalEquations(body, blocks, gradient, *_border(body, axes, data, sums), cost)

    def differentiate(self, pose: Pose, *, by_betas: bool) -> KeypointJacobian:
        """Return the points with derivatives by the unknowns (frames, points, 3, 36) in `pose`.

        Some frames at a time, so that the derivatives by all angles stay in the processor's cache.
        """
        parameters, frames = pose.parameters(), len(pose.transl)
        keypoints, betas, rows = (np.empty(0) for _ in range(3))
        cached_frames = 64  # Frames that are differentiated together: 2 MB of derivatives.
        for start in range(0, frames, cached_frames):
            part = slice(start, start + cached_frames)
            body = self.chained.differentiate(parameters[part], by_betas=by_betas)
            if not start:
                keypoints = np.empty((frames, *body.keypoints.shape[1:]))
                betas = np.empty((frames, *body.betas.shape[1:]))
                rows = np.empty((*keypoints.shape, 6 + pose.angles.shape[1]))
            keypoints[part], betas[part] = body.keypoints, body.betas
            rows[part] = differentiate_points(body.pose, pose.angles.shape[1])
        return KeypointJacobian(keypoints, betas, rows)


@dataclass(eq=False)
class PointSums:
    """Sums of the terms on points: derivatives by the points, before those by the unknowns."""

    force: Floats
    """(frames, points, 3), first derivative of the cost."""
    bands: list[Floats]
    """(frames, points) each: weight of a point with itself, and in the next two frames."""
    information: Floats
    """(frames, points, 3, 3), of the data."""
    held: Floats
    """(frames, 2) weights of the heights of ankles [1/m^2]."""
    above: Floats
    """(frames, 2) heights of ankles above standing ones [m]."""
    cost: float = 0.0

    @classmethod
    def empty(cls, frames: int, points: int) -> PointSums:
        """Return sums of no terms."""
        bands = [np.zeros((frames, points)) for _ in range(3)]
        none = np.zeros((frames, len(ANKLES)))
        return cls(np.zeros((frames, points, 3)), bands, np.empty(0), none, none)

    def by_unknowns(self, rows: Floats, tied: bool) -> tuple[Floats, Floats]:
        """Return blocks (3, frames, 36, 36) and gradient (frames, 36) by derivatives of points.

        Only the first blocks, if no term ties frames.
        """
        stiff = self.information.copy()
        stiff[..., np.arange(3), np.arange(3)] += self.bands[0][..., None]
        stiff[:, ANKLES, 2, 2] += self.held
        self.force[:, ANKLES, 2] += self.held * self.above
        return accumulate_points(rows, stiff, self.bands[1], self.bands[2], self.force, tied)


def add_data(
    sums: PointSums, perceived: Floats, evidence: PersonEvidence, loss_scale: float
) -> Floats:
    """Add E_data = sum_tj rho(r_tj^T W_tj r_tj; c), r = P + A o - X; return its derivative by P.

    Args:
        sums: changed.
        perceived: (frames, points, 3) [m], points where the detector sees them.
        evidence: X and W.
        loss_scale: of the loss [standard deviations].
    """
    residual = np.where(evidence.known[..., None], perceived - evidence.joints, 0.0)
    weighted = np.einsum("fjab,fjb->fja", evidence.information, residual)
    deviation = np.einsum("fja,fja->fj", residual, weighted) / loss_scale**2
    weight = 1.0 / (1.0 + deviation)
    sums.cost += 0.5 * loss_scale**2 * float(np.log1p(deviation).sum())
    sums.information = weight[..., None, None] * evidence.information
    force: Floats = weight[..., None] * weighted
    sums.force += force
    return force


def acceleration_scale(points: int) -> Floats:
    """Return the accelerations (points,) of keypoints as multiples of the hips' [1]."""
    further = points - len(ACCELERATION_SCALE)
    # A body accelerates as one: many points tell no more of it than those of the feet.
    # Acceleration of points besides COCO-17 as a multiple of the hips': heels and toes.
    many = 6.0 * max(1.0, further / len(FEET)) ** 0.5
    scale: Floats = np.concatenate([ACCELERATION_SCALE, np.full(further, many)])
    return scale


def add_smoothness(
    sums: PointSums, keypoints: Floats, std: Floats, tail: float, starts: Sequence[int]
) -> None:
    """Add E_smooth = sum_tj rho(|P_t+2,j - 2 P_t+1,j + P_tj|^2 / s_j^2; c).

    Args:
        sums: changed.
        keypoints: (frames, points, 3) [m].
        std: (points,) standard deviation s of second differences [m].
        tail: scale of the loss [variances].
        starts: first frames of intervals that no motion ties to the ones before.
    """
    frames = len(keypoints)
    if frames <= 2:
        return
    second = keypoints[2:] - 2.0 * keypoints[1:-1] + keypoints[:-2]
    for start in starts:
        second[max(0, start - 2) : start] = 0.0
    deviation = (second**2).sum(-1) / std**2 / tail
    sums.cost += 0.5 * tail * float(np.log1p(deviation).sum())
    weight = 1.0 / (1.0 + deviation) / std**2
    for start in starts:
        weight[max(0, start - 2) : start] = 0.0
    weighted = weight[..., None] * second
    for start, factor in ((0, 1.0), (1, -2.0), (2, 1.0)):
        sums.force[start : frames - 2 + start] += factor * weighted
        sums.bands[0][start : frames - 2 + start] += factor**2 * weight
    sums.bands[1][:-2] -= 2.0 * weight
    sums.bands[1][1:-1] -= 2.0 * weight
    sums.bands[2][:-2] += weight


def add_slip(sums: PointSums, keypoints: Floats, contacts: Contacts, std: float) -> None:
    """Add E_slip, the motion of standing ankles, with its standard deviation per frame [m]."""
    if len(keypoints) < 2:
        return
    slip = np.diff(keypoints[:, ANKLES], axis=0)
    held = contacts.slipping / std**2
    sums.cost += 0.5 * float((held[..., None] * slip**2).sum())
    for side, ankle in enumerate(ANKLES):
        sums.force[1:, ankle] += held[:, side, None] * slip[:, side]
        sums.force[:-1, ankle] -= held[:, side, None] * slip[:, side]
        sums.bands[0][1:, ankle] += held[:, side]
        sums.bands[0][:-1, ankle] += held[:, side]
        sums.bands[1][:-1, ankle] -= held[:, side]


def add_contact(sums: PointSums, keypoints: Floats, contacts: Contacts, std: float) -> None:
    """Add E_contact, with the standard deviation [m] of heights.

    A standing ankle has the height of a flat foot's, and no ankle is below it.
    """
    sums.above = keypoints[:, ANKLES, 2] - contacts.height
    sums.held = np.where(sums.above < 0.0, 1.0, contacts.standing) / std**2
    sums.cost += 0.5 * float((sums.held * sums.above**2).sum())


class PriorTerm(NamedTuple):
    """A quadratic term: cost, first derivative, and second derivative or its diagonal."""

    cost: float
    gradient: Floats
    matrix: Floats


def pose_term(angles: Floats, prior: PosePrior, weight: float) -> PriorTerm:
    """Return E_pose of angles (frames, 30) [rad]."""
    matrix = weight * prior.precision
    away = angles - prior.mean
    slope = away @ matrix
    return PriorTerm(0.5 * float((slope * away).sum()), slope, matrix)


def limit_term(angles: Floats, std: float) -> PriorTerm:
    """Return E_limit of angles (frames, 30) [rad], with the diagonal of its second derivative."""
    size = angles.shape[1]
    beyond = np.maximum(angles - MAX_ANGLES[:size], 0.0)
    beyond = beyond + np.minimum(angles - MIN_ANGLES[:size], 0.0)
    stiff = 1.0 / std**2
    cost = 0.5 * stiff * float((beyond**2).sum())
    return PriorTerm(cost, stiff * beyond, stiff * (beyond != 0.0))


def shape_term(betas: Floats, mean: Floats, precision: Floats) -> PriorTerm:
    """Return E_shape = 1/2 (beta - beta_0)^T B (beta - beta_0) of betas (shapes,)."""
    away = betas - mean
    slope = precision @ away
    return PriorTerm(0.5 * float(away @ slope), slope, precision)


def offset_term(unknowns: Floats, variance: float, weight: float) -> PriorTerm:
    """Return E_offset of the offsets' unknowns (26,) [m] with this variance each [m^2]."""
    matrix = weight / variance * np.eye(len(unknowns))
    slope = matrix @ unknowns
    return PriorTerm(0.5 * float(unknowns @ slope), slope, matrix)


def _border(
    body: KeypointJacobian, axes: Floats, data: Floats, sums: PointSums
) -> tuple[Floats, Floats, Floats]:
    """Return border, corner and gradient of betas and offsets, which all frames share."""
    frames, points = body.keypoints.shape[:2]
    shapes = body.betas.shape[-1]
    width = shapes + MIRRORED_OFFSETS.shape[-1]
    rows = body.pose.reshape(frames, 3 * points, -1)
    by_shared = np.zeros((frames, points, 3, width))
    by_shared[..., :shapes] = body.betas
    by_shared[:, :17, :, shapes:] = np.einsum("fab,jbu->fjau", axes, MIRRORED_OFFSETS)
    columns = by_shared.reshape(frames, 3 * points, width)
    stiffened = (sums.information @ by_shared).reshape(columns.shape)
    border = np.swapaxes(rows, 1, 2) @ stiffened
    corner = np.einsum("fka,fkb->ab", columns, stiffened, optimize=True)
    shared = np.einsum("fka,fk->a", columns, data.reshape(frames, 3 * points))
    for side, ankle in enumerate(ANKLES):  # the height of the body's own ankles
        row, column = body.pose[:, ankle, 2], body.betas[:, ankle, 2]
        heavy = sums.held[:, side, None] * column
        border[..., :shapes] += row[:, :, None] * heavy[:, None]
        corner[:shapes, :shapes] += heavy.T @ column
        shared[:shapes] += sums.above[:, side] @ heavy
    return border, corner, shared
