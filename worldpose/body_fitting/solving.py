"""Least squares over a track: the poses of all its frames (S3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body import BodyParameters
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.parameters import BODY_POSE
from worldpose.body_fitting.banded import BandedFactor
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.evidence import Evidence
from worldpose.body_fitting.feet import Ground, ankle_height, find_contacts, level_feet
from worldpose.body_fitting.monocular_prior import Guidance
from worldpose.body_fitting.objective import LIVELINESS, UNKNOWNS, Pose, Track
from worldpose.body_fitting.pose_space import PosePrior
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shared_bias import body_axes
from worldpose.body_fitting.starting import bridged, start_poses
from worldpose.errors import DegenerateError
from worldpose.geometry import Rigid

ALIKE: Final = float((1.0 / LIVELINESS**2).sum())
"""Number of hip accelerations that equal independent accelerations of all keypoints [1]. But a body
accelerates as one: the search may count them all, the covariance of its poses may not."""


@dataclass(frozen=True, eq=False)
class Solver:
    """Solver of poses, shared by the fits of all persons."""

    chained: ChainedKeypoints
    prior: PosePrior
    settings: BodyFittingSettings
    ground: Ground | None

    def poses(
        self,
        evidence: Evidence,
        shape: Shape,
        offsets: Floats,
        fps: float,
        guidance: Guidance | None = None,
    ) -> tuple[Pose, BandedFactor]:
        """Return one person's poses in all frames, and the factor of their information matrix.

        With `guidance` there are two searches. One starts from the monocular poses, and the result
        of lower cost counts: steps from an interpolated start do not reach a body that turned
        unseen, and the cost of a start says little about the cost of its result.
        """
        settings, model = self.settings, self.chained.model
        track = Track(
            self.chained,
            evidence,
            self.prior,
            settings,
            fps,
            settings.acceleration,
            settings.pose_weight,
            guidance=guidance,
        )
        target = bridged(evidence.joints)
        with np.errstate(invalid="ignore"):
            axes = body_axes(target)
        moved = target - np.einsum("fab,jb->fja", axes, offsets)
        target = np.where(np.isfinite(moved), moved, target)
        pose = Pose(*start_poses(model, shape.betas, target, self.prior), shape.betas)
        searched = self.search(track, pose, offsets)
        if guidance is not None:
            guided = self.search(track, led(pose, guidance), offsets)
            # Compare the same terms: each search has its own standing ankles.
            costs = [
                track.equations(p, offsets, bordered=False).cost for p, _ in (searched, guided)
            ]
            searched = guided if costs[1] < costs[0] else searched
        pose, track = searched
        doubtful = replace(
            track,
            acceleration=track.acceleration * ALIKE**0.5,
            contacts=None if track.contacts is None else track.contacts.of(evidence.known),
        )
        return pose, factor(doubtful.equations(pose, offsets, bordered=False).blocks)

    def search(self, track: Track, pose: Pose, offsets: Floats) -> tuple[Pose, Track]:
        """Return the pose after Gauss-Newton steps, and the track with standing ankles."""
        for step in range(self.settings.steps):
            if self.ground is not None and step == self.settings.steps // 2:
                track = self.standing(track, pose)
            equations = track.equations(pose, offsets, bordered=False)
            step_of = factor(equations.blocks).solve(equations.gradient[..., None])
            pose = pose.moved(-step_of[..., 0])
        return pose, track

    def standing(self, track: Track, pose: Pose) -> Track:
        """Return the track with the ankles that stand in a pose."""
        assert self.ground is not None
        joints = self.chained.differentiate(pose.parameters()).keypoints
        height = ankle_height(self.chained.model, pose.betas)
        contacts = find_contacts(joints, height, self.ground, track.fps, self.settings)
        return replace(track, contacts=contacts)

    def planted(self, pose: Pose) -> BodyParameters:
        """Return the bodies of a pose, with feet on the ground where they are near it."""
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
            angles[:, foot - 1] = Rigid(turned, np.zeros(3)).rotvec
        return replace(parameters, body_pose=angles.reshape(-1, BODY_POSE))


def led(pose: Pose, guidance: Guidance) -> Pose:
    """Return a pose with the monocular poses of the frames where they count.

    Gaps between these, no longer than their errors last, take the pose of the nearest frame: no
    step would remove a jump between poses of two sources.
    """
    frames, used = np.arange(len(guidance.used)), np.flatnonzero(guidance.used)
    before = used[(np.searchsorted(used, frames, side="right") - 1).clip(min=0)]
    after = used[np.searchsorted(used, frames).clip(max=len(used) - 1)]
    inside = (before <= frames) & (frames <= after) & (after - before <= guidance.witnesses)
    nearest = np.where(frames - before <= after - frames, before, after)
    known = Rigid(guidance.orient[nearest], np.zeros(3)).rotvec
    return replace(
        pose,
        orient=np.where(inside[:, None], known, pose.orient),
        angles=np.where(inside[:, None], guidance.angles[nearest], pose.angles),
    )


def factor(blocks: Floats) -> BandedFactor:
    """Return the factor of blocks with a little damping.

    Raises:
        DegenerateError: rounding leaves no positive definite system.
    """
    places = np.arange(UNKNOWNS)
    blocks[0][:, places, places] *= 1.0 + 1e-4
    # 10 m and 10 rad: only a lone joint leaves a direction that uncertain.
    blocks[0][:, places, places] += 0.01
    solved = BandedFactor.of(blocks)
    if not solved.determined:
        raise DegenerateError(
            "body fitting: the joints' weights differ by more than double precision holds. Give "
            "the settings of body_fitting and triangulation values nearer to their defaults."
        )
    return solved
