"""Objective of one person's track, and its normal equations (S3).

Terms: triangulated joints, minus the detector's systematic offsets; small second differences of
keypoints; pose prior and joint limits; monocular poses; standing ankles, and none below the ground.
A triangulated joint with its covariance represents the reprojections of the inlier views, to first
order, so these are not counted a second time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body import BodyParameters
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body_fitting.evidence import Evidence
from worldpose.body_fitting.feet import ANKLES, Contacts
from worldpose.body_fitting.monocular_prior import Guidance
from worldpose.body_fitting.pose_space import HIGHEST, LOWEST, SIZE, SPREAD, PosePrior
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shared_bias import MIRRORED_OFFSETS, body_axes

UNKNOWNS: Final = 6 + SIZE
"""Unknowns per frame: translation, orientation and angles."""
LIVELINESS: Final = np.array([1, 1, 1, 1, 1, 1, 1, 2, 2, 3, 3, 1, 1, 5, 5, 5, 5], dtype=np.float64)
"""Accelerations of joints as multiples of the hips'; averages of simulated players."""
_LARGEST_TURN: Final = 0.6
"""Maximum change of an angle per step [rad]; beyond it the linear model is invalid."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Unknowns of a track."""

    transl: Floats
    """(frames, 3) [m]"""
    orient: Floats
    """(frames, 3) [rad]"""
    angles: Floats
    """(frames, 30) [rad], of `pose_space`."""
    betas: Floats
    """(shapes,)"""

    def parameters(self) -> BodyParameters:
        """Return the bodies (frames,)."""
        return BodyParameters(self.betas, self.orient, self.angles @ SPREAD.T, self.transl)

    def moved(self, step: Floats, betas: Floats | float = 0.0) -> Pose:
        """Return the pose after a step (frames, 36), with rotations clipped to the linear range."""
        turns = np.clip(step[:, 3:], -_LARGEST_TURN, _LARGEST_TURN)
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

    blocks: Floats
    """(3, frames, 36, 36)"""
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
class Track:
    """Evidence and priors of one person's track."""

    chained: ChainedKeypoints
    evidence: Evidence
    prior: PosePrior
    settings: BodyFittingSettings
    fps: float
    acceleration: float
    """Standard deviation of the hips' acceleration [m/s^2]."""
    pose_weight: float
    """Weight of the pose prior in each frame [1]."""
    contacts: Contacts | None = None
    guidance: Guidance | None = None

    def equations(self, pose: Pose, offsets: Floats, *, bordered: bool) -> NormalEquations:
        """Return the normal equations at a pose.

        Args:
            pose: where to linearise.
            offsets: (17, 3) [m] forward, left, up, from a body's joints to the detector's.
            bordered: with betas and offsets; else the border is empty.
        """
        frames, settings = len(pose.transl), self.settings
        body = self.chained.differentiate(pose.parameters())
        shapes = body.betas.shape[-1]
        by_frame = np.empty((frames, 17, 3, UNKNOWNS))
        by_frame[..., :3] = np.eye(3)
        by_frame[..., 3:6] = body.global_orient
        by_frame[..., 6:] = body.body_pose @ SPREAD
        rows = by_frame.reshape(frames, 51, UNKNOWNS)

        axes = body_axes(body.keypoints)
        known = self.evidence.known
        seen_at = body.keypoints + np.einsum("fab,jb->fja", axes, offsets)
        residual = np.where(known[..., None], seen_at - self.evidence.joints, 0.0)
        pulled = np.einsum("fjab,fjb->fja", self.evidence.information, residual)
        deviation = np.einsum("fja,fja->fj", residual, pulled) / settings.tail**2
        cost = 0.5 * settings.tail**2 * float(np.log1p(deviation).sum())
        weight = 1.0 / (1.0 + deviation)
        information = weight[..., None, None] * self.evidence.information
        pulled = weight[..., None] * pulled

        bands, smooth_pull, smooth_cost = self._smoothness(body.keypoints)
        turned = np.swapaxes(rows, 1, 2)
        blocks = np.zeros((3, frames, UNKNOWNS, UNKNOWNS))
        stiff = information.copy()
        stiff[..., np.arange(3), np.arange(3)] += bands[0][..., None]
        blocks[0] = turned @ (stiff @ by_frame).reshape(rows.shape)
        for ahead in (1, 2):
            if frames > ahead:
                scaled = np.repeat(bands[ahead][:-ahead], 3, axis=1)[..., None] * rows[:-ahead]
                blocks[ahead, :-ahead] = turned[ahead:] @ scaled
        gradient = (turned @ (pulled + smooth_pull).reshape(frames, 51, 1))[..., 0]
        cost += smooth_cost + self._add_angles(pose.angles, blocks[0], gradient)
        if self.guidance is not None:
            matrix, pull, guided_cost = self.guidance.pull(pose.orient, pose.angles)
            blocks[0][:, 3:, 3:] += matrix
            gradient[:, 3:] += pull
            cost += guided_cost

        width = shapes + MIRRORED_OFFSETS.shape[-1] if bordered else 0
        border, corner = np.zeros((frames, UNKNOWNS, width)), np.zeros((width, width))
        shared = np.zeros(width)
        if bordered:
            by_shared = np.zeros((frames, 17, 3, width))
            by_shared[..., :shapes] = body.betas
            by_shared[..., shapes:] = np.einsum("fab,jbu->fjau", axes, MIRRORED_OFFSETS)
            columns = by_shared.reshape(frames, 51, width)
            held = (information @ by_shared).reshape(columns.shape)
            border = turned @ held
            corner = np.einsum("fka,fkb->ab", columns, held, optimize=True)
            shared = np.einsum("fka,fk->a", columns, pulled.reshape(frames, 51))
        equations = NormalEquations(blocks, gradient, border, corner, shared, cost)
        if self.contacts is None:
            return equations
        return self._standing(equations, body.keypoints, by_frame, body.betas)

    def _smoothness(self, keypoints: Floats) -> tuple[list[Floats], Floats, float]:
        """Return weights (frames, 17) on the three diagonals, gradient (frames, 17, 3) and cost.

        They cover second differences of keypoints, and motion of standing ankles.
        """
        settings, frames = self.settings, len(keypoints)
        bands = [np.zeros((frames, 17)) for _ in range(3)]
        pull, cost = np.zeros_like(keypoints), 0.0
        if frames > 2:
            spread = self.acceleration * LIVELINESS / self.fps**2
            second = keypoints[2:] - 2.0 * keypoints[1:-1] + keypoints[:-2]
            tail = 3.0 * settings.acceleration_tail**2
            deviation = (second**2).sum(-1) / spread**2 / tail
            cost = 0.5 * tail * float(np.log1p(deviation).sum())
            weight = 1.0 / (1.0 + deviation) / spread**2
            pulled = weight[..., None] * second
            for start, factor in ((0, 1.0), (1, -2.0), (2, 1.0)):
                pull[start : frames - 2 + start] += factor * pulled
                bands[0][start : frames - 2 + start] += factor**2 * weight
            bands[1][:-2] -= 2.0 * weight
            bands[1][1:-1] -= 2.0 * weight
            bands[2][:-2] += weight
        if self.contacts is not None and frames > 1:
            slip = np.diff(keypoints[:, ANKLES], axis=0)
            held = self.contacts.slipping / settings.slip_spread**2
            cost += 0.5 * float((held[..., None] * slip**2).sum())
            for side, ankle in enumerate(ANKLES):
                pull[1:, ankle] += held[:, side, None] * slip[:, side]
                pull[:-1, ankle] -= held[:, side, None] * slip[:, side]
                bands[0][1:, ankle] += held[:, side]
                bands[0][:-1, ankle] += held[:, side]
                bands[1][:-1, ankle] -= held[:, side]
        return bands, pull, cost

    def _add_angles(self, angles: Floats, blocks: Floats, gradient: Floats) -> float:
        """Add the pose prior and the joint limits; return their cost."""
        prior = self.pose_weight * self.prior.precision
        away = angles - self.prior.mean
        beyond = np.maximum(angles - HIGHEST, 0.0) + np.minimum(angles - LOWEST, 0.0)
        stiff = 1.0 / self.settings.limit_spread**2
        gradient[:, 6:] += away @ prior + stiff * beyond
        blocks[:, 6:, 6:] += prior
        places = np.arange(6, UNKNOWNS)
        blocks[:, places, places] += stiff * (beyond != 0.0)
        return 0.5 * float(((away @ prior) * away).sum() + stiff * (beyond**2).sum())

    def _standing(
        self, equations: NormalEquations, keypoints: Floats, by_frame: Floats, by_betas: Floats
    ) -> NormalEquations:
        """Return the equations with terms for the height of standing ankles, and none below it."""
        contacts = self.contacts
        assert contacts is not None
        blocks, gradient = equations.blocks, equations.gradient
        border, corner = equations.border, equations.corner
        shared, cost = equations.border_gradient, equations.cost
        shapes = by_betas.shape[-1] if len(corner) else 0
        for side, ankle in enumerate(ANKLES):
            above = keypoints[:, ankle, 2] - contacts.height[:, side]
            weight = np.where(above < 0.0, 1.0, contacts.standing[:, side])
            weight = weight / self.settings.contact_spread**2
            cost += 0.5 * float((weight * above**2).sum())
            row, column = by_frame[:, ankle, 2], by_betas[:, ankle, 2, :shapes]
            heavy = weight[:, None] * row
            blocks[0] += heavy[:, :, None] * row[:, None]
            gradient += above[:, None] * heavy
            border[..., :shapes] += heavy[..., None] * column[:, None]
            corner[:shapes, :shapes] += (weight[:, None] * column).T @ column
            shared[:shapes] += (weight * above) @ column
        return NormalEquations(blocks, gradient, border, corner, shared, cost)
