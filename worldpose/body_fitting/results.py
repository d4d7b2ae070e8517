"""Input and results of body fitting, for one clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from worldpose.body.model import BODY_POSE, BodyModel, BodyParameters
from worldpose.body_fitting.evidence import body_axes, modelled_variance
from worldpose.body_fitting.monocular import MonocularPoses
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.ray_constraints import RayConstraints
from worldpose.body_fitting.residuals import Pose
from worldpose.body_fitting.shapes import Shapes
from worldpose.errors import InputError
from worldpose.geometry.rows import join_rows, take_rows
from worldpose.ingest.clock import row_rate
from worldpose.triangulation.results import ExtraJoints, Triangulation


class EvidenceSource(Protocol):
    """Evidence about the bodies of a clip that is read by frames: a long clip exceeds memory."""

    @property
    def size(self) -> tuple[int, int]:
        """Number of frames and of persons."""

    @property
    def fps(self) -> float:
        """Frames per second [1/s]."""

    def read_joints(self, frames: slice) -> ClipEvidence:
        """Return the triangulated joints and points of some frames."""

    def read(self, frames: slice) -> ClipEvidence:
        """Return all evidence in some frames."""


@dataclass(frozen=True, eq=False)
class ClipEvidence:
    """Evidence about the bodies of one clip.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world, COCO-17; NaN where missing.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`.
        fps: [1/s].
        common_bias: (17,) per axis, error that all views share [m], whose square is part of
            `covariance`; None = none.
        ray_constraints: lines of sight of joints that are not triangulated, for the same frames and
            persons; they keep a person present from the first to the last triangulated joint.
        monocular_poses: poses of the same frames and persons, used where few joints are well
            determined.
        shared_covariance: (frames, persons, 3, 3) [m^2], the part of `covariance` that moves all
            joints of a person together: no number of joints reduces it. NaN = unknown in this
            frame; None = none.
        extra: points besides COCO-17 of the same frames and persons; None = none.

    Raises:
        InputError: the shapes do not match, or `fps` is not positive.
    """

    joints: Floats
    covariance: Floats
    fps: float
    common_bias: Floats | None = None
    ray_constraints: Sequence[RayConstraints] = ()
    monocular_poses: MonocularPoses | None = None
    shared_covariance: Floats | None = None
    extra: ExtraJoints | None = None

    def __post_init__(self) -> None:
        for name in ("joints", "covariance"):
            object.__setattr__(self, name, np.asarray(getattr(self, name)))
        shape = self.joints.shape
        if len(shape) != 4 or shape[2:] != (17, 3) or self.covariance.shape != (*shape, 3):
            raise InputError(
                "body fitting",
                expected="joints (frames, persons, 17, 3), covariance (frames, persons, 17, 3, 3)",
                found=f"{shape} and {self.covariance.shape}",
                todo="Give triangulated joints with their covariance.",
            )
        row_rate("body fitting", self.fps)

    def require_bias(self) -> None:
        """Raise InputError if `covariance` is smaller than the square of `common_bias`."""
        if not self.bias.any():
            return
        seen = self.joint_seen
        xx, yy, zz, xy, xz, yz = (
            self.covariance[..., a, b][seen].astype(np.float64)
            for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        )
        # Numbers of a file are rounded to float32.
        less = np.broadcast_to(modelled_variance(self.bias), seen.shape)[seen]
        less -= 1e-6 * (xx + yy + zz)
        xx, yy, zz = xx - less, yy - less, zz - less
        # Sylvester's criterion: eigenvalues of all joints of a clip take a second.
        minor = xx * yy - xy**2
        whole = zz * minor - xx * yz**2 - yy * xz**2 + 2.0 * xy * xz * yz
        short = (xx < 0.0) | (minor < 0.0) | (whole < 0.0)
        if short.any():
            raise InputError(
                "body fitting: common_bias",
                expected="an error [m] whose square is part of the covariance of each joint",
                found=f"{self.bias.max():g}, more than the covariance of {short.sum()} joints",
                todo="Add its square to the diagonal of covariance, or give no common_bias.",
            )

    @staticmethod
    def of(placed: Triangulation, fps: float, rays: RayConstraints) -> ClipEvidence:
        """Return the evidence of triangulated joints and points, and of lines of sight."""
        return ClipEvidence(
            placed.joints,
            placed.covariance,
            fps,
            placed.common_bias,
            [rays],
            shared_covariance=placed.shared_covariance,
            extra=placed.extra,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Number of frames and of persons."""
        frames, persons = self.joints.shape[:2]
        return frames, persons

    @property
    def bias(self) -> Floats:
        """(17,) per axis, error that all views share [m]; 0 where none is known."""
        return np.zeros(17) if self.common_bias is None else self.common_bias

    @property
    def joint_seen(self) -> Flags:
        """(frames, persons, 17), joints with a covariance."""
        return np.asarray(
            np.isfinite(self.joints).all(-1) & np.isfinite(self.covariance).all((-1, -2))
        )

    def read_joints(self, frames: slice) -> ClipEvidence:
        """Return the evidence in some frames."""
        return self.read(frames)

    def read(self, frames: slice) -> ClipEvidence:
        """Return the evidence in some frames."""
        monocular, shared, extra = self.monocular_poses, self.shared_covariance, self.extra
        return replace(
            self,
            joints=self.joints[frames],
            covariance=self.covariance[frames],
            ray_constraints=[view[frames] for view in self.ray_constraints],
            monocular_poses=None if monocular is None else monocular[frames],
            shared_covariance=None if shared is None else shared[frames],
            extra=None if extra is None else extra[frames],
        )


@dataclass(frozen=True, eq=False)
class ExtraFit:
    """Points besides COCO-17 of fitted bodies.

    Attributes:
        points: (points,) names.
        joints: (frames, persons, points, 3) [m], world, where the body model has them.
        covariance: (frames, persons, points, 3, 3) [m^2].
        offsets: (points, 3) [m] left, up and forward in the axes of the point's segment: from the
            body's point to the detector's.
    """

    points: tuple[str, ...]
    joints: Floats
    covariance: Floats
    offsets: Floats


@dataclass(frozen=True, eq=False)
class BodyFit:
    """Bodies of one clip.

    Attributes:
        betas: (persons, shapes); NaN for a person without any joint.
        parameters: (frames, persons), NaN where a person is missing.
        betas_covariance: (persons, shapes, shapes).
        joints: (frames, persons, 17, 3) [m], world: COCO-17 keypoints of the bodies.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`: poses by the objective, the
            detector's offsets, each person's own, and different joint definitions of detector and
            body model: offsets and shape together follow the detector.
        filled: (frames, persons), bodies in frames without any joint of theirs.
        guided: (frames, persons), bodies fitted with a monocular pose.
        offsets: (17, 3) [m] forward, left and up: from a body's joints to the detector's.
        extra: points besides COCO-17; None without evidence about any.
    """

    betas: Floats
    parameters: BodyParameters
    betas_covariance: Floats
    joints: Floats
    covariance: Floats
    filled: NDArray[np.bool_]
    guided: NDArray[np.bool_]
    offsets: Floats
    extra: ExtraFit | None = None

    @classmethod
    def of(cls, arrays: FittedArrays, shapes: Shapes) -> BodyFit:
        """Return the fit of complete arrays."""
        betas = np.broadcast_to(arrays.betas, (*arrays.orient.shape[:2], arrays.betas.shape[-1]))
        return cls(
            arrays.betas,
            BodyParameters(betas, arrays.orient, arrays.body_pose, arrays.transl),
            arrays.betas_covariance,
            arrays.joints,
            arrays.covariance,
            arrays.filled,
            arrays.guided,
            shapes.offsets,
            arrays.extra,
        )

    def __getitem__(self, frames: slice) -> BodyFit:
        """Return the bodies in some frames."""
        return self._join([self], frames)

    @classmethod
    def concatenate(cls, parts: Sequence[BodyFit]) -> BodyFit:
        """Return the bodies of consecutive parts of a clip."""
        return cls._join(parts, slice(None))

    @staticmethod
    def _join(parts: Sequence[BodyFit], frames: slice) -> BodyFit:
        def join(name: str) -> Any:  # noqa: ANN401
            return np.concatenate([getattr(part, name)[frames] for part in parts])

        points = [
            take_rows(part.extra, frames, "points", "offsets")
            for part in parts
            if part.extra is not None
        ]
        return replace(
            parts[0],
            parameters=join_rows([take_rows(part.parameters, frames) for part in parts]),
            extra=join_rows(points, "points", "offsets") if points else None,
            **{name: join(name) for name in ("joints", "covariance", "filled", "guided")},
        )


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
    extra: ExtraFit | None = None

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
        solver: PoseSolver,
        person: int,
        span: slice,
        pose: Pose,
        joints: tuple[Floats, Floats],
        shapes: Shapes,
        determined: NDArray[np.bool_] | None = None,
    ) -> BodyParameters:
        """Write the result of one person, and return the bodies with their feet.

        `joints` are the keypoints (frames, 17, 3) [m] and their covariance (frames, 17, 3, 3)
        [m^2]; `determined` is as `seen` of `PoseSolver.plant_feet`.

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
        arrays = [self.orient, self.body_pose, self.transl, self.joints, self.covariance]
        if self.extra is not None:
            arrays += [self.extra.joints, self.extra.covariance]
        for array in arrays:
            array[span, person][gone] = np.nan
        self.filled[span, person] &= ~gone
        self.guided[span, person] &= ~gone
