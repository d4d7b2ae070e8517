"""Least squares over tracks: shapes with what the detector always gets wrong, then poses (S3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from worldpose.body import BodyParameters
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.parameters import BODY_POSE
from worldpose.body_fitting.banded import BandedFactor
from worldpose.body_fitting.bones import Shape, fit_shape, measure_bones
from worldpose.body_fitting.evidence import DIFFICULTY, Evidence
from worldpose.body_fitting.feet import Ground, ankle_height, find_contacts, level_feet
from worldpose.body_fitting.objective import UNKNOWNS, Pose, Track
from worldpose.body_fitting.pose_space import PosePrior
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shared_bias import MIRRORED_OFFSETS, body_axes
from worldpose.body_fitting.starting import bridged, start_poses
from worldpose.cameras import Rigid

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solver:
    """What all persons' fits have in common."""

    chained: ChainedKeypoints
    prior: PosePrior
    settings: BodyFittingSettings
    ground: Ground | None

    def shape(
        self, people: dict[int, tuple[Floats, Floats]], fps: float
    ) -> tuple[dict[int, Shape], Floats]:
        """Return everybody's betas and the offsets (17, 3), from some of the frames.

        Args:
            people: joints (frames, 17, 3) and covariance of each.
            fps: [1/s].
        """
        model, settings = self.chained.model, self.settings
        stride = max(1, int(fps / settings.shape_rate))
        rate = fps / stride
        tracks: dict[int, Track] = {}
        poses: dict[int, Pose] = {}
        found: dict[int, Shape] = {}
        scale = (settings.noise_scale * DIFFICULTY[:, None, None]) ** 2
        for person, (joints, covariance) in people.items():
            some = joints[::stride]
            evidence = Evidence.of(some, covariance[::stride], rate, settings)
            tracks[person] = Track(
                self.chained, evidence, self.prior, settings, rate, settings.shape_acceleration
            )
            bones = measure_bones(joints, scale * covariance, 1.0 + settings.noise_time * fps)
            found[person] = fit_shape(model, bones)
            betas = found[person].betas
            start = start_poses(model, betas, bridged(some), self.prior)
            poses[person] = Pose(*start, betas)
        unknowns = np.zeros(MIRRORED_OFFSETS.shape[-1])
        expected = settings.bias_spread**2
        count = model.shapes
        for step in range(settings.shape_steps if people else 0):
            offsets = MIRRORED_OFFSETS @ unknowns
            if self.ground is not None and step == settings.shape_steps // 2:
                tracks = {p: self._with_contacts(t, poses[p]) for p, t in tracks.items()}
            matrix = np.eye(len(unknowns)) / expected
            right = matrix @ unknowns
            solved = {}
            for person, track in tracks.items():
                equations = track.equations(poses[person], offsets, bordered=True)
                factor = _factor(equations.blocks)
                sides = np.concatenate([equations.border, equations.gradient[..., None]], axis=-1)
                inner = factor.solve(sides)
                flat = equations.border.reshape(-1, len(equations.corner)).T
                reduced = flat @ inner.reshape(flat.shape[1], -1)
                corner = equations.corner - reduced[:, :-1]
                own = equations.border_gradient - reduced[:, -1]
                inverse = np.linalg.inv(corner[:count, :count])
                matrix = matrix + corner[count:, count:]
                matrix = matrix - corner[count:, :count] @ inverse @ corner[:count, count:]
                right = right + own[count:] - corner[count:, :count] @ inverse @ own[:count]
                solved[person] = inner, corner, own, inverse
            change = -np.linalg.solve(matrix, right)
            spread = np.linalg.inv(matrix)
            unknowns = unknowns + change
            # How far this detector goes is learnt with where it goes (expectation-maximisation).
            if step >= settings.shape_steps // 2:
                expected = float(unknowns @ unknowns + np.trace(spread)) / len(unknowns)
            for person, (inner, corner, own, inverse) in solved.items():
                by_offsets = inverse @ corner[:count, count:]
                betas = -inverse @ own[:count] - by_offsets @ change
                # Far steps of the first, roughest linearisation leave the people.
                betas = np.clip(betas, -1.0, 1.0)
                border_step = np.concatenate([betas, change])
                moved = -inner[..., -1] - inner[..., :-1] @ border_step
                poses[person] = poses[person].moved(moved, betas)
                found[person] = Shape(
                    poses[person].betas, inverse + by_offsets @ spread @ by_offsets.T
                )
        return found, MIRRORED_OFFSETS @ unknowns

    def poses(
        self, evidence: Evidence, shape: Shape, offsets: Floats, fps: float
    ) -> tuple[Pose, BandedFactor]:
        """Return one person's poses in all frames, and the factor of the last step."""
        settings = self.settings
        track = Track(self.chained, evidence, self.prior, settings, fps, settings.acceleration)
        target = bridged(evidence.joints)
        with np.errstate(invalid="ignore"):
            axes = body_axes(target)
        moved = target - np.einsum("fab,jb->fja", axes, offsets)
        target = np.where(np.isfinite(moved), moved, target)
        model = self.chained.model
        pose = Pose(*start_poses(model, shape.betas, target, self.prior), shape.betas)
        for step in range(settings.steps):
            if self.ground is not None and step == settings.steps // 2:
                track = self._with_contacts(track, pose)
            equations = track.equations(pose, offsets, bordered=False)
            factor = _factor(equations.blocks)
            pose = pose.moved(-factor.solve(equations.gradient[..., None])[..., 0])
        return pose, factor

    def _with_contacts(self, track: Track, pose: Pose) -> Track:
        """The track with the ankles that stand in a pose."""
        assert self.ground is not None
        joints = self.chained.differentiate(pose.parameters()).keypoints
        height = ankle_height(self.chained.model, pose.betas)
        contacts = find_contacts(joints, height, self.ground, track.fps, self.settings)
        return replace(track, contacts=contacts)

    def planted(self, pose: Pose) -> BodyParameters:
        """The bodies of a pose, with feet on the ground where they are near it."""
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


def _factor(blocks: Floats) -> BandedFactor:
    """The factor of blocks with a little damping."""
    places = np.arange(UNKNOWNS)
    blocks[0][:, places, places] *= 1.0 + 1e-4
    # 10 m and 10 rad: only a lone joint leaves a direction that free.
    blocks[0][:, places, places] += 0.01
    factor = BandedFactor.of(blocks)
    assert factor.determined
    return factor
