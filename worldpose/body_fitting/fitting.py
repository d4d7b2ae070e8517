"""Bodies for every person of a clip: shape, then place, orientation and angles in every frame."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from worldpose.body import BodyModel, BodyParameters, fold_keypoints
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.parameters import BODY_POSE
from worldpose.body_fitting.banded import BandedFactor
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.evidence import Evidence
from worldpose.body_fitting.feet import Ground
from worldpose.body_fitting.objective import Pose
from worldpose.body_fitting.pose_space import SPREAD, load_pose_prior
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.solving import Solver
from worldpose.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BodyFit:
    """Bodies of a clip.

    Attributes:
        betas: (persons, shapes); NaN for a person without any joint.
        parameters: (frames, persons), NaN where a person is missing.
        betas_covariance: (persons, shapes, shapes).
        joints: (frames, persons, 17, 3) [m], world: COCO-17 keypoints of the bodies.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints` from the objective, betas and
            offsets taken as known.
        filled: (frames, persons), bodies in frames without any joint of theirs.
        offsets: (17, 3) [m] forward, left and up: from joints to what the detector takes for them.
    """

    betas: Floats
    parameters: BodyParameters
    betas_covariance: Floats
    joints: Floats
    covariance: Floats
    filled: NDArray[np.bool_]
    offsets: Floats


def fit_bodies(
    model: BodyModel,
    joints: Floats,
    covariance: Floats,
    fps: float,
    settings: BodyFittingSettings,
    ground: Ground | None = None,
) -> BodyFit:
    """Return the bodies that explain everybody's triangulated joints (S1-S3).

    Shape starts from bone lengths, poses from hips and torso; then betas, coarse poses and the
    detector's shared offsets are estimated together, and last the poses of all frames with betas
    and offsets held.

    Args:
        model: the body.
        joints: (frames, persons, 17, 3) [m], world, COCO-17; NaN where missing.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`.
        fps: [1/s].
        settings: what is expected of detectors, bodies and motion.
        ground: height of the surface under the feet, in a world with z up; None where unknown.

    Raises:
        InputError: the shapes do not fit together.
    """
    if joints.ndim != 4 or joints.shape[2:] != (17, 3) or covariance.shape != (*joints.shape, 3):
        raise InputError(
            "body fitting",
            expected="joints (frames, persons, 17, 3) and covariance (frames, persons, 17, 3, 3)",
            found=f"{joints.shape} and {covariance.shape}",
            todo="Give triangulated joints with their covariance.",
        )
    frames, persons = joints.shape[:2]
    solver = Solver(
        ChainedKeypoints.of(fold_keypoints(model, COCO17)), load_pose_prior(), settings, ground
    )
    joint_seen = np.isfinite(joints).all(-1) & np.isfinite(covariance).all((-1, -2))
    seen = np.asarray(joint_seen.any(-1))
    spans = {
        person: slice(int(here[0]), int(here[-1]) + 1)
        for person in range(persons)
        if len(here := np.flatnonzero(seen[:, person]))
    }
    evidence = {
        person: Evidence.of(joints[span, person], covariance[span, person], fps, settings)
        for person, span in spans.items()
    }
    shapes, offsets = solver.shape(
        {
            person: (joints[span, person], covariance[span, person])
            for person, span in spans.items()
        },
        fps,
    )
    result = _Result.empty(model, frames, persons)
    for person, span in spans.items():
        pose, factor = solver.poses(evidence[person], shapes[person], offsets, fps)
        result.put(solver, person, span, pose, factor, shapes[person])
        own = seen[span, person]
        result.filled[span, person] = ~own
        result.drop(person, span, _too_long(own, settings.longest_gap * fps))
    return result.fit(offsets)


def _too_long(seen: NDArray[np.bool_], most: float) -> NDArray[np.bool_]:
    """Frames in gaps of more than `most` frames."""
    places = np.flatnonzero(seen)
    long = np.zeros(len(seen), dtype=bool)
    for first, last in itertools.pairwise(places):
        if last - first - 1 > most:
            long[first + 1 : last] = True
    return long


@dataclass(frozen=True, eq=False)
class _Result:
    """A fit under way."""

    betas: Floats
    orient: Floats
    body_pose: Floats
    transl: Floats
    betas_covariance: Floats
    joints: Floats
    covariance: Floats
    filled: NDArray[np.bool_]

    @classmethod
    def empty(cls, model: BodyModel, frames: int, persons: int) -> _Result:
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
        )

    def put(
        self,
        solver: Solver,
        person: int,
        span: slice,
        pose: Pose,
        factor: BandedFactor,
        shape: Shape,
    ) -> None:
        """Write one person's part."""
        body = solver.chained.differentiate(pose.parameters())
        planted = solver.planted(pose)
        self.betas[person] = shape.betas
        self.betas_covariance[person] = shape.covariance
        self.orient[span, person] = planted.global_orient
        self.body_pose[span, person] = planted.body_pose
        self.transl[span, person] = planted.transl
        self.joints[span, person] = body.keypoints
        pose_part = body.body_pose @ SPREAD
        by_frame = np.concatenate(
            [np.broadcast_to(np.eye(3), (*pose_part.shape[:-1], 3)), body.global_orient, pose_part],
            axis=-1,
        )
        spread = factor.inverse_blocks()[:, None]
        self.covariance[span, person] = by_frame @ spread @ by_frame.swapaxes(-1, -2)

    def drop(self, person: int, span: slice, gone: NDArray[np.bool_]) -> None:
        """Take a person out of frames of a span."""
        for array in (self.orient, self.body_pose, self.transl, self.joints, self.covariance):
            array[span, person][gone] = np.nan
        self.filled[span, person] &= ~gone

    def fit(self, offsets: Floats) -> BodyFit:
        """The whole."""
        betas = np.broadcast_to(self.betas, (*self.orient.shape[:2], self.betas.shape[-1]))
        parameters = BodyParameters(betas, self.orient, self.body_pose, self.transl)
        return BodyFit(
            self.betas,
            parameters,
            self.betas_covariance,
            self.joints,
            self.covariance,
            self.filled,
            offsets,
        )
