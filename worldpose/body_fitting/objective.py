"""Evidence about one person's track, and the objective with its normal equations (S3).

Terms: triangulated joints, minus the detector's systematic offsets; small second differences of
keypoints; pose prior and joint limits; monocular poses; standing ankles, and none below the ground.
A triangulated joint with its covariance represents the reprojections of the inlier views, to first
order, so these are not counted a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17, COCO17_SIGMAS, FEET
from worldpose.body.jacobian import ChainedKeypoints, KeypointJacobian
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.monocular import MonocularPrior
from worldpose.body_fitting.point_equations import accumulate_points, invert_symmetric
from worldpose.body_fitting.pose_space import (
    MAX_ANGLES,
    MIN_ANGLES,
    SIZE,
    SPREADS,
    PosePrior,
    cross,
    differentiate_points,
)
from worldpose.body_fitting.settings import BodyFittingSettings

JOINT_SPREAD: Final = np.array(COCO17_SIGMAS) / 0.08
"""Spread of each joint relative to an average one: COCO's sigmas over their mean of 0.08."""

MIN_INFORMATION: Final = 1e-6
"""Added to singular information [1/m^2]: one line leaves a direction undetermined."""


def _basis() -> Floats:
    """Return offsets (17, 3, unknowns) by unknowns: forward, left and up of each joint or pair."""
    columns = []
    for joint, name in enumerate(COCO17):
        if name.startswith("right"):
            continue
        mirrored = COCO17.index(name.replace("left", "right"))
        # A joint that is its own mirror image lies in the middle plane.
        for axis in (0, 1, 2) if mirrored != joint else (0, 2):
            column = np.zeros((len(COCO17), 3))
            column[joint, axis] = 1.0
            column[mirrored, axis] = -1.0 if axis == 1 else 1.0
            columns.append(column)
    return np.stack(columns, axis=-1)


MIRRORED_OFFSETS: Final = _basis()
"""(17, 3, 26)"""


def body_axes(joints: Floats) -> Floats:
    """Return columns forward, left and up (..., 3, 3) of bodies whose joints are (..., 17, 3).

    Left follows hips and shoulders, up follows the trunk.
    """
    left = joints[..., 5, :] + joints[..., 11, :] - joints[..., 6, :] - joints[..., 12, :]
    up = joints[..., 5, :] + joints[..., 6, :] - joints[..., 11, :] - joints[..., 12, :]
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    front = cross(left, up)
    front /= np.linalg.norm(front, axis=-1, keepdims=True)
    axes: Floats = np.stack([front, left, cross(front, left)], axis=-1)
    return axes


def perceived_joints(joints: Floats, offsets: Floats) -> Floats:
    """Return the detector's joints (frames, persons, 17, 3) of bodies [m], world.

    Args:
        joints: (frames, persons, 17, 3) [m], world.
        offsets: (17, 3) [m] from a body's joint to the detector's: forward, left, up.
    """
    moved: Floats = joints + np.einsum("fpab,jb->fpja", body_axes(joints), offsets)
    return moved


@dataclass(frozen=True, eq=False)
class Evidence:
    """Joints of one person with their information."""

    joints: Floats
    """(frames, 17, 3) [m]; NaN where unknown."""
    information: Floats
    """(frames, 17, 3, 3) [1/m^2], inverse covariance; 0 where unknown."""

    def add_points(
        self, joints: Floats, covariance: Floats, fps: float, settings: BodyFittingSettings
    ) -> Evidence:
        """Return the evidence with points besides COCO-17 after it.

        Args:
            joints: (frames, points, 3) [m], world; NaN where missing.
            covariance: (frames, points, 3, 3) [m^2], as triangulation states it.
            fps: [1/s].
            settings: scale and correlation time of the noise.
        """
        own = self.of(joints, covariance, fps, settings)
        return Evidence(
            np.concatenate([self.joints, own.joints], axis=1),
            np.concatenate([self.information, own.information], axis=1),
        )

    @property
    def known(self) -> NDArray[np.bool_]:
        """(frames, 17), joints with any information."""
        return np.asarray(self.information.any(axis=(-1, -2)))

    @classmethod
    def of(
        cls, joints: Floats, covariance: Floats, fps: float, settings: BodyFittingSettings
    ) -> Evidence:
        """Return the evidence of joints whose errors last for `noise_time_s`.

        Args:
            joints: (frames, 17, 3) [m], world; or other points.
            covariance: (frames, 17, 3, 3) [m^2], as triangulation states it.
            fps: [1/s].
            settings: scale and correlation time of the noise.
        """
        seen = np.asarray(np.isfinite(joints).all(-1) & np.isfinite(covariance).all((-1, -2)))
        stated = np.where(seen[..., None, None], covariance, np.eye(3))
        relative = JOINT_SPREAD if joints.shape[1] == len(JOINT_SPREAD) else np.ones(1)
        spread = settings.noise_scale**2 * relative[:, None, None] ** 2 * stated
        spread = spread + settings.min_joint_std_m**2 * np.eye(3)
        # Correlated frames count as one observation.
        spread *= 1.0 + settings.noise_time_s * fps
        information = invert_symmetric(spread) * seen[..., None, None]
        return cls(np.where(seen[..., None], joints, np.nan), information)

    def add_rays(
        self, points: Floats, across: Floats, fps: float, settings: BodyFittingSettings
    ) -> Evidence:
        """Return the evidence with lines of sight added.

        Args:
            points: (frames, 17, 3) [m], world, on the lines; NaN without.
            across: (frames, 17, 3, 3) [1], projections across the lines; 0 without.
            fps: [1/s].
            settings: standard deviation of a joint from its line.
        """
        rows = np.flatnonzero(np.isfinite(points).all(-1).any(-1))
        if not len(rows):
            return self
        points, across = points[rows], across[rows]
        joints, information = self.joints.copy(), self.information.copy()
        seen = np.asarray(np.isfinite(points).all(-1))
        spread = (settings.ray_std_m * JOINT_SPREAD) ** 2 + settings.min_joint_std_m**2
        spread *= 1.0 + settings.noise_time_s * fps
        information[rows] += np.where(seen[..., None, None], across / spread[:, None, None], 0.0)
        # From the point on the line towards the known joint; a lone line has no force along
        # itself.
        away = np.where(np.isfinite(joints[rows]), joints[rows], points) - points
        weighted = self.information[rows] @ np.nan_to_num(away)[..., None]
        moved = np.linalg.solve(information[rows] + MIN_INFORMATION * np.eye(3), weighted)[..., 0]
        joints[rows] = np.where(seen[..., None], points + moved, joints[rows])
        return Evidence(joints, information)


Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""

ANKLES: Final = (15, 16)
"""Ankles in COCO-17."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Standing feet of one person, and the height of a standing ankle."""

    standing: Floats
    """(frames, 2) 1 where an ankle stands, else 0."""
    slipping: Floats
    """(frames - 1, 2) 1 where it stands in this and the next frame."""
    height: Floats
    """(frames, 2) [m], world: a flat foot's ankle there, the minimum of any ankle."""

    def of(self, seen: NDArray[np.bool_]) -> Contacts:
        """Return the contacts of seen ankles (frames, 17); unseen ankles may stand or not."""
        ankles = seen[:, ANKLES]
        both = ankles[1:] & ankles[:-1]
        return Contacts(self.standing * ankles, self.slipping * both, self.height)


def find_contacts(
    joints: Floats,
    ankle_height: float,
    ground: Ground,
    fps: float,
    settings: BodyFittingSettings,
    starts: Sequence[int] = (),
) -> Contacts:
    """Return contacts of ankles that are low and slow for at least two frames.

    Args:
        joints: (frames, 17, 3) [m], world, of a fit.
        ankle_height: height of this person's ankle above the sole [m].
        ground: the surface.
        fps: [1/s].
        settings: limits of low and slow.
        starts: first frames of the track's further intervals, as in `Track`.
    """
    ankles = joints[:, ANKLES]
    height = ground(ankles[..., 0], ankles[..., 1]) + ankle_height
    if len(joints) < 2:
        return Contacts(np.zeros(height.shape), np.zeros((0, 2)), height)
    speed = np.linalg.norm(np.diff(ankles, axis=0), axis=-1) * fps
    low = ankles[..., 2] - height < settings.contact_height_m
    slipping = (speed < settings.contact_speed_m_s) & low[1:] & low[:-1]
    slipping[np.array(starts, dtype=np.int64) - 1] = False
    standing = np.zeros(low.shape, dtype=bool)
    standing[1:] |= slipping
    standing[:-1] |= slipping
    return Contacts(standing.astype(np.float64), slipping.astype(np.float64), height)


def ankle_height(model: BodyModel, betas: Floats) -> float:
    """Return the height of the ankles of an upright body above its soles [m]."""
    lowest = int(model.template[:, 1].argmin())
    sole = model.template[lowest, 1] + model.shape_directions[lowest, 1] @ betas
    joints = model.joint_template + model.joint_directions @ betas
    return float(joints[7:9, 1].mean() - sole)


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
    """(3, frames, 36, 36), those on the diagonal valid in the lower triangle."""
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
    monocular_prior: MonocularPrior | None = None
    starts: tuple[int, ...] = ()
    """First frames of the intervals after the first; motion ties no interval to another."""

    def equations(self, pose: Pose, offsets: Floats, *, bordered: bool) -> NormalEquations:
        """Return the normal equations at a pose.

        Args:
            pose: where to linearise.
            offsets: (17, 3) [m] forward, left, up, from a body's joints to the detector's.
            bordered: whether the equations have a border for betas and offsets.
        """
        frames, settings = len(pose.transl), self.settings
        body = self.differentiate(pose, by_betas=bordered)
        points = body.pose.shape[1]
        # The points besides COCO-17 already lie where the detector has them.
        offsets = np.concatenate([offsets, np.zeros((points - len(offsets), 3))])

        axes = body_axes(body.keypoints)
        known = self.evidence.known
        seen_at = body.keypoints + np.einsum("fab,jb->fja", axes, offsets)
        residual = np.where(known[..., None], seen_at - self.evidence.joints, 0.0)
        weighted = np.einsum("fjab,fjb->fja", self.evidence.information, residual)
        deviation = np.einsum("fja,fja->fj", residual, weighted) / settings.loss_scale**2
        cost = 0.5 * settings.loss_scale**2 * float(np.log1p(deviation).sum())
        weight = 1.0 / (1.0 + deviation)
        information = weight[..., None, None] * self.evidence.information
        weighted = weight[..., None] * weighted

        bands, force, smooth_cost = self._smoothness(body.keypoints)
        force += weighted
        stiff = information.copy()
        stiff[..., np.arange(3), np.arange(3)] += bands[0][..., None]
        held, above = self._weigh_heights(body.keypoints)
        stiff[:, ANKLES, 2, 2] += held
        force[:, ANKLES, 2] += held * above
        blocks, gradient = accumulate_points(body.pose, stiff, bands[1], bands[2], force)
        cost += smooth_cost + 0.5 * float((held * above**2).sum())
        cost += self._add_angles(pose.angles, blocks[0], gradient)
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

        shapes = body.betas.shape[-1]
        width = shapes + MIRRORED_OFFSETS.shape[-1]
        rows = body.pose.reshape(frames, 3 * points, -1)
        by_shared = np.zeros((frames, points, 3, width))
        by_shared[..., :shapes] = body.betas
        by_shared[:, :17, :, shapes:] = np.einsum("fab,jbu->fjau", axes, MIRRORED_OFFSETS)
        columns = by_shared.reshape(frames, 3 * points, width)
        stiffened = (information @ by_shared).reshape(columns.shape)
        border = np.swapaxes(rows, 1, 2) @ stiffened
        corner = np.einsum("fka,fkb->ab", columns, stiffened, optimize=True)
        shared = np.einsum("fka,fk->a", columns, weighted.reshape(frames, 3 * points))
        for side, ankle in enumerate(ANKLES):  # the height of the body's own ankles
            row, column = body.pose[:, ankle, 2], body.betas[:, ankle, 2]
            heavy = held[:, side, None] * column
            border[..., :shapes] += row[:, :, None] * heavy[:, None]
            corner[:shapes, :shapes] += heavy.T @ column
            shared[:shapes] += above[:, side] @ heavy
        return NormalEquations(body, blocks, gradient, border, corner, shared, cost)

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

    def _smoothness(self, keypoints: Floats) -> tuple[list[Floats], Floats, float]:
        """Return weights (frames, points) on the three diagonals, gradient (..., 3) and cost.

        They cover second differences of keypoints, and motion of standing ankles.
        """
        settings, frames = self.settings, len(keypoints)
        points = keypoints.shape[1]
        bands = [np.zeros((frames, points)) for _ in range(3)]
        slope, cost = np.zeros_like(keypoints), 0.0
        if frames > 2:
            further = points - len(ACCELERATION_SCALE)
            # A body accelerates as one: many points tell no more of it than those of the feet.
            # Acceleration of points besides COCO-17 as a multiple of the hips': heels and toes.
            many = 6.0 * max(1.0, further / len(FEET)) ** 0.5
            scale = np.concatenate([ACCELERATION_SCALE, np.full(further, many)])
            spread = self.acceleration * scale / self.fps**2
            second = keypoints[2:] - 2.0 * keypoints[1:-1] + keypoints[:-2]
            tail = 3.0 * settings.acceleration_loss_scale**2
            for start in self.starts:
                second[max(0, start - 2) : start] = 0.0
            deviation = (second**2).sum(-1) / spread**2 / tail
            cost = 0.5 * tail * float(np.log1p(deviation).sum())
            weight = 1.0 / (1.0 + deviation) / spread**2
            for start in self.starts:
                weight[max(0, start - 2) : start] = 0.0
            weighted = weight[..., None] * second
            for start, factor in ((0, 1.0), (1, -2.0), (2, 1.0)):
                slope[start : frames - 2 + start] += factor * weighted
                bands[0][start : frames - 2 + start] += factor**2 * weight
            bands[1][:-2] -= 2.0 * weight
            bands[1][1:-1] -= 2.0 * weight
            bands[2][:-2] += weight
        if self.contacts is not None and frames > 1:
            slip = np.diff(keypoints[:, ANKLES], axis=0)
            held = self.contacts.slipping / settings.slip_std_m**2
            cost += 0.5 * float((held[..., None] * slip**2).sum())
            for side, ankle in enumerate(ANKLES):
                slope[1:, ankle] += held[:, side, None] * slip[:, side]
                slope[:-1, ankle] -= held[:, side, None] * slip[:, side]
                bands[0][1:, ankle] += held[:, side]
                bands[0][:-1, ankle] += held[:, side]
                bands[1][:-1, ankle] -= held[:, side]
        return bands, slope, cost

    def _add_angles(self, angles: Floats, blocks: Floats, gradient: Floats) -> float:
        """Add the pose prior and the joint limits; return their cost."""
        prior = self.pose_weight * self.prior.precision
        away = angles - self.prior.mean
        size = angles.shape[1]
        beyond = np.maximum(angles - MAX_ANGLES[:size], 0.0)
        beyond = beyond + np.minimum(angles - MIN_ANGLES[:size], 0.0)
        stiff = 1.0 / self.settings.limit_std_rad**2
        gradient[:, 6:] += away @ prior + stiff * beyond
        blocks[:, 6:, 6:] += prior
        places = np.arange(6, 6 + size)
        blocks[:, places, places] += stiff * (beyond != 0.0)
        return 0.5 * float(((away @ prior) * away).sum() + stiff * (beyond**2).sum())

    def _weigh_heights(self, keypoints: Floats) -> tuple[Floats, Floats]:
        """Return weights [1/m^2] and heights [m] of ankles above standing ones (frames, 2).

        A standing ankle has the height of a flat foot's, and no ankle is below it.
        """
        if self.contacts is None:
            none = np.zeros((len(keypoints), len(ANKLES)))
            return none, none
        above = keypoints[:, ANKLES, 2] - self.contacts.height
        weight = np.where(above < 0.0, 1.0, self.contacts.standing)
        return weight / self.settings.contact_std_m**2, above
