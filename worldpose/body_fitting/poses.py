"""Poses of one person in all frames, for a known shape: Gauss-Newton on the objective."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.evidence import (
    Ground,
    PersonEvidence,
    ankle_height,
    body_axes,
    find_contacts,
)
from worldpose.body_fitting.monocular import MonocularPrior
from worldpose.body_fitting.point_equations import propagate, propagate_alone
from worldpose.body_fitting.pose_space import PosePrior, interpolate_gaps, level_feet, start_poses
from worldpose.body_fitting.residuals import ACCELERATION_SCALE, PersonObjective, Pose
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.geometry.rigid import Rigid


@dataclass(frozen=True, eq=False)
class PoseSolver:
    """Solver of poses, shared by the fits of all persons."""

    chained: ChainedKeypoints
    prior: PosePrior
    settings: BodyFittingSettings
    ground: Ground | None

    def solve_poses(
        self,
        evidence: PersonEvidence,
        shape: Shape,
        offsets: Floats,
        fps: float,
        monocular_prior: MonocularPrior | None = None,
    ) -> tuple[Pose, PersonObjective]:
        """Return one person's poses in all frames, and the track with its standing ankles.

        With `monocular_prior` there are two searches. One starts from the monocular poses, and the
        result of lower cost counts: steps from an interpolated start do not reach a body that
        turned unseen, and the cost of a start says little about the cost of its result.
        """
        settings, model = self.settings, self.chained.model
        objective = PersonObjective(
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
        searched = self.search(objective, pose, offsets)
        if monocular_prior is not None:
            guided = self.search(objective, start_from_monocular(pose, monocular_prior), offsets)
            # Compare the same terms: each search has its own standing ankles.
            costs = [
                objective.equations(p, offsets, bordered=False).cost for p, _ in (searched, guided)
            ]
            searched = guided if costs[1] < costs[0] else searched
        return searched

    def search(
        self, objective: PersonObjective, pose: Pose, offsets: Floats
    ) -> tuple[Pose, PersonObjective]:
        """Return the pose after Gauss-Newton steps, and the track with standing ankles."""
        for step in range(self.settings.steps):
            if self.ground is not None and step == self.settings.steps // 2:
                objective = self.find_standing_ankles(objective, pose)
            pose = _take_step(objective, pose, offsets)
        return pose, objective

    def find_standing_ankles(self, objective: PersonObjective, pose: Pose) -> PersonObjective:
        """Return the track with the ground contacts of its ankles in a pose."""
        assert self.ground is not None
        joints = self.chained.place(pose.parameters())
        height = ankle_height(self.chained.model, pose.betas)
        contacts = find_contacts(
            joints, height, self.ground, objective.fps, self.settings, objective.starts
        )
        return replace(objective, contacts=contacts)

    def plant_feet(self, pose: Pose, seen: NDArray[np.bool_] | None = None) -> BodyParameters:
        """Return the bodies of a pose, with feet that are near the ground turned level with it.

        If points of a foot, left or right, determine its pose, `seen` (frames, 2), it stays; None =
        neither.
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


def _take_step(objective: PersonObjective, pose: Pose, offsets: Floats) -> Pose:
    """Return the pose after one Gauss-Newton step; its equations are gone before the next ones."""
    equations = objective.equations(pose, offsets, bordered=False)
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


def damp_motion(objective: PersonObjective) -> PersonObjective:
    """Return a solved objective for the covariance of its poses: a body accelerates as one."""
    contacts = objective.contacts
    # Number of hip accelerations that equal independent accelerations of all keypoints [1]. But a
    # body accelerates as one: the search may count them all, the covariance of its poses may not.
    acceleration_weight = float((1.0 / ACCELERATION_SCALE**2).sum())
    return replace(
        objective,
        acceleration=objective.acceleration * acceleration_weight**0.5,
        contacts=None if contacts is None else contacts.of(objective.evidence.known),
    )


def pose_covariance(
    objective: PersonObjective, pose: Pose, offsets: Floats
) -> tuple[Floats, Floats]:
    """Return a solved track's points (frames, points, 3) [m] and their covariance.

    The covariance (frames, points, 3, 3) [m^2] is that of the poses. Errors last for about
    `noise_time_s`, so that a frame of the track has that much less weight. Where a point moves too
    freely to gain from other frames, its own frame alone determines it, with all its weight: the
    smaller of both covariances is that of a point. `offsets` (17, 3) [m] are the detector's.
    """
    equations = damp_motion(objective).equations(pose, offsets, bordered=False)
    body = equations.points
    random = propagate(body.pose, factor(equations.blocks).inverse_blocks())
    alone = replace(objective, acceleration=np.inf, contacts=None)
    blocks = alone.equations(pose, offsets, bordered=False, points=body).blocks
    blocks *= objective.settings.repeated(objective.fps)
    single = propagate_alone(body.pose, _damp(blocks)[0])
    smaller = np.einsum("tpii->tp", single) < np.einsum("tpii->tp", random)
    return body.keypoints, np.where(smaller[..., None, None], single, random)


def _damp(blocks: Floats) -> Floats:
    """Return blocks (bands, frames, n, n) with a little damping, which overwrites them."""
    places = np.arange(blocks.shape[-1])
    blocks[0][:, places, places] *= 1.0 + 1e-4
    # Information of every unknown [1/m^2, 1/rad^2]: 10 m and 10 rad.
    blocks[0][:, places, places] += 0.01
    return blocks


def factor(blocks: Floats) -> BandedFactor:
    """Return the factor of slightly damped blocks, overwritten; DegenerateError by rounding."""
    solved = BandedFactor.of(_damp(blocks), overwrite=True)
    if not solved.determined:
        raise DegenerateError(
            "body fitting: the weights of the joints differ by more than double precision can "
            "hold. Give the settings of body_fitting and triangulation values nearer to their "
            "defaults."
        )
    return solved
