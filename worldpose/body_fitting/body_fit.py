"""Bodies of every person of a clip: shape, then position, orientation and angles per frame.

Quality metrics of a fit need no ground truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.bones import Shape
from worldpose.body_fitting.extra_points import (
    ExtraFit,
    PointArrays,
    PointModel,
    densest_interval,
    feet_determined,
    known_points,
    learn_points,
    select_points,
)
from worldpose.body_fitting.monocular import MonocularPoses, MonocularPrior, monocular_priors
from worldpose.body_fitting.objective import Evidence, Ground
from worldpose.body_fitting.pose_space import load_pose_prior, nearest_matrices
from worldpose.body_fitting.ray_constraints import RayConstraints
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.solver import (
    FittedArrays,
    Shapes,
    Solver,
    fit_shapes,
    pose_covariance,
    spread_intervals,
)
from worldpose.body_fitting.windows import long_gaps, split_windows, trim_people
from worldpose.compiled import map_in_threads
from worldpose.errors import InputError
from worldpose.triangulation.passes import ExtraJoints


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
        def join(name: str, of: Sequence[object] = parts) -> NDArray[Any]:
            return np.concatenate([getattr(part, name)[frames] for part in of])

        first = parts[0]
        moving = [part.parameters for part in parts]
        names = ("betas", "global_orient", "body_pose", "transl")
        points = [part.extra for part in parts if part.extra is not None]
        return replace(
            first,
            parameters=BodyParameters(*(join(name, moving) for name in names)),
            joints=join("joints"),
            covariance=join("covariance"),
            filled=join("filled"),
            guided=join("guided"),
            extra=replace(
                points[0], joints=join("joints", points), covariance=join("covariance", points)
            )
            if points
            else None,
        )


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
        common_bias: (17,) per axis, error that all views share [m]; None = none.
        ray_constraints: lines of sight of joints that are not triangulated, for the same frames and
            persons; a person without joints is present as long as these last.
        monocular_poses: poses of the same frames and persons, used where few joints are well
            determined (S4).
        shared_covariance: (frames, persons, 3, 3) [m^2], the part of `covariance` that moves all
            joints of a person together: no number of joints reduces it. NaN = unknown in this
            frame; None = none.
        extra: points besides COCO-17 of the same frames and persons; None = none.

    Raises:
        InputError: the shapes do not match.
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
        shape = self.joints.shape
        if len(shape) != 4 or shape[2:] != (17, 3) or self.covariance.shape != (*shape, 3):
            raise InputError(
                "body fitting",
                expected="joints (frames, persons, 17, 3), covariance (frames, persons, 17, 3, 3)",
                found=f"{shape} and {self.covariance.shape}",
                todo="Give triangulated joints with their covariance.",
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


def fit_bodies(
    model: BodyModel,
    evidence: EvidenceSource,
    settings: BodyFittingSettings = BodyFittingSettings(),  # noqa: B008
    ground: Ground | None = None,
    known_shapes: Mapping[int, Shape] | None = None,
) -> BodyFit:
    """Return the bodies that fit the triangulated joints of all persons (S1-S3).

    Args:
        model: the body.
        evidence: triangulated joints, and other observations of the same clip.
        settings: expected errors of detectors, bodies and motion.
        ground: height of the surface under the feet, in a world with z up; None where unknown.
        known_shapes: shapes of people from other clips, by their index in the joints.
    """
    parts = fit_in_windows(model, evidence, settings, ground, known_shapes)
    return BodyFit.concatenate([fit for _, fit in parts])


def fit_in_windows(
    model: BodyModel,
    evidence: EvidenceSource,
    settings: BodyFittingSettings = BodyFittingSettings(),  # noqa: B008
    ground: Ground | None = None,
    known_shapes: Mapping[int, Shape] | None = None,
) -> Iterator[tuple[slice, BodyFit]]:
    """Yield the bodies of `fit_bodies` for consecutive frames of a clip of any length.

    Shape starts from bone lengths, poses from hips and torso; then betas, coarse poses and the
    detector's shared offsets are estimated together from some seconds of each person, and last the
    poses of all frames with fixed betas and offsets.

    Yields:
        Frames, and the bodies in these frames.
    """
    clip = _learn_clip(
        evidence,
        Solver(
            ChainedKeypoints.of(fold_keypoints(model, COCO17)), load_pose_prior(), settings, ground
        ),
        known_shapes or {},
    )
    for window, kept in split_windows(evidence.size[0], evidence.fps, settings):
        # Not bound here, so that its memory is free while the next window is fitted.
        yield kept, clip.fit(evidence.read(window), window, kept)


def _learn_clip(
    evidence: EvidenceSource, solver: Solver, known_shapes: Mapping[int, Shape]
) -> _ClipBodies:
    """Return the shapes and offsets of a clip."""
    (frames, persons), fps = evidence.size, evidence.fps
    parts = [kept for _, kept in split_windows(frames, fps, solver.settings)]
    seen = np.zeros((frames, persons), dtype=np.bool_)
    number = np.zeros((frames, persons), dtype=np.int16)
    points: dict[str, None] = {}
    for part in parts:
        some = evidence.read_joints(part)
        seen[part] = some.joint_seen.any(-1)
        if some.extra is not None:
            names = known_points(solver.chained.model, some.extra.points)
            extra = select_points(some.extra, names)
            there = np.isfinite(extra.joints[..., 0])
            number[part] = there.sum(axis=-1)
            points |= dict.fromkeys(np.array(names)[there.any(axis=(0, 1))].tolist())
    spans = {
        person: slice(int(here[0]), int(here[-1]) + 1)
        for person in range(persons)
        if len(here := np.flatnonzero(seen[:, person]))
    }
    sampled = {
        person: [
            slice(span.start + part.start, span.start + part.stop)
            for part in spread_intervals(span.stop - span.start, fps, solver.settings)
        ]
        for person, span in spans.items()
    }
    shapes = fit_shapes(solver, _read_samples(evidence, parts, sampled), known_shapes, fps)
    if not points or not spans:
        return _ClipBodies(solver, shapes, spans, fps)
    samples = {}
    for person, span in spans.items():
        part = densest_interval(number[span, person], fps)
        some = evidence.read(slice(span.start + part.start, span.start + part.stop))
        assert some.extra is not None
        covariance = random_covariance(some.covariance, some.bias)
        own, _ = _gather_evidence(some, covariance, {person: slice(None)}, solver.settings)
        extra = select_points(some.extra, tuple(points))
        alone = replace(
            extra,
            joints=extra.joints[:, [person]],
            covariance=extra.covariance[:, [person]],
            views=extra.views[:, [person]],
        )
        samples[person] = own[person], alone
    return _ClipBodies(solver, shapes, spans, fps, learn_points(solver, samples, shapes, fps))


def _read_samples(
    evidence: EvidenceSource, parts: Sequence[slice], sampled: Mapping[int, Sequence[slice]]
) -> dict[int, list[tuple[Floats, Floats]]]:
    """Return joints and covariance of each person in some intervals, which parts of a clip hold."""
    read: dict[int, list[tuple[Floats, Floats]]] = {
        person: [
            (
                np.empty((each.stop - each.start, 17, 3)),
                np.empty((each.stop - each.start, 17, 3, 3)),
            )
            for each in intervals
        ]
        for person, intervals in sampled.items()
    }
    for part in parts:
        some = evidence.read_joints(part)
        for person, intervals in sampled.items():
            for each, (joints, covariance) in zip(intervals, read[person], strict=True):
                first, last = max(each.start, part.start), min(each.stop, part.stop)
                if first < last:
                    to = slice(first - each.start, last - each.start)
                    of = slice(first - part.start, last - part.start)
                    joints[to] = some.joints[of, person]
                    covariance[to] = random_covariance(some.covariance[of, person], some.bias)
    return read


@dataclass(frozen=True, eq=False)
class _ClipBodies:
    """Shapes, offsets and spans, which all frames of a clip share.

    Attributes:
        spans: frames from a person's first joint to the last.
        points: points besides COCO-17; None without evidence about any.
    """

    solver: Solver
    shapes: Shapes
    spans: Mapping[int, slice]
    fps: float
    points: PointModel | None = None

    def fit(self, evidence: ClipEvidence, window: slice, kept: slice) -> BodyFit:
        """Return the bodies in some frames, fitted in a window around them.

        Where the window begins or ends without any observation of a person, or the frames to keep
        have none, the person is missing.
        """
        settings, bias, fps = self.solver.settings, evidence.bias, self.fps
        covariance = random_covariance(evidence.covariance, bias)
        joint_seen = evidence.joint_seen
        seen = np.asarray(joint_seen.any(-1))
        spans = {
            person: slice(max(span.start, window.start) - window.start, last - window.start)
            for person, span in self.spans.items()
            if (last := min(span.stop, window.stop)) > max(span.start, window.start)
        }
        people, present = _gather_evidence(evidence, covariance, spans, settings)
        extra = points = None
        if self.points is not None and evidence.extra is not None:
            extra = PointArrays.empty(self.points, *evidence.size)
            points = select_points(evidence.extra, self.points.points)
            people = {
                person: self.points.add(person, own, points[spans[person]], fps)
                for person, own in people.items()
            }
        core = slice(kept.start - window.start, kept.stop - window.start)
        spans, people = trim_people(spans, people, core.start, core.stop)
        solver = self.solver if self.points is None else self.points.solver
        model = self.solver.chained.model
        result = FittedArrays.empty(model, *evidence.size)

        def fit_person(person: int, prior: MonocularPrior | None = None) -> None:
            own, span = people[person], spans[person]
            shape = self.shapes.people[person]
            pose, track = solver.solve_poses(own, shape, self.shapes.offsets, fps, prior)
            places, random = pose_covariance(track, pose, self.shapes.offsets)
            spread = random[:, :17] + bias[:, None, None] ** 2 * np.eye(3)
            determined = None
            if self.points is not None:
                determined = feet_determined(model, self.points.points, own, fps)
            bodies = result.put(
                solver, person, span, pose, (places[:, :17], spread), self.shapes, determined
            )
            if extra is not None:
                extra.put(person, span, bodies, random[:, 17:])

        for _ in map_in_threads(fit_person, spans):
            pass
        if evidence.monocular_poses is not None:
            priors = monocular_priors(
                (result.orient, result.body_pose),
                joint_seen,
                covariance,
                evidence.monocular_poses,
                spans,
                fps,
            )
            for person, prior in priors.items():
                fit_person(person, prior)
                result.guided[spans[person], person] = prior.used
        for person, span in spans.items():
            result.filled[span, person] = ~seen[span, person]
            gone = long_gaps(present[span, person], settings.max_filled_gap_s * fps)
            shared = evidence.shared_covariance
            moving = None if shared is None else nearest_matrices(shared[span, person])[:, None]
            for arrays in (result,) if extra is None else (result, extra):
                arrays.drop(person, span, gone)
                if moving is not None:
                    arrays.covariance[span, person] += moving
        for person in self.spans:  # also of people who are not in this window
            result.betas[person] = self.shapes.people[person].betas
            result.betas_covariance[person] = self.shapes.people[person].covariance
        fit = BodyFit.of(result, self.shapes)
        fit = fit if extra is None else replace(fit, extra=extra.fit())
        return fit if kept == window else fit[core]


def _gather_evidence(
    evidence: ClipEvidence,
    covariance: Floats,
    spans: Mapping[int, slice],
    settings: BodyFittingSettings,
) -> tuple[dict[int, Evidence], Flags]:
    """Return each person's joints and lines of sight, and the frames (frames, persons) with any."""
    fps, present = evidence.fps, np.asarray(evidence.joint_seen.any(-1))
    for view in evidence.ray_constraints:
        present = present | view.seen

    def gather(person: int) -> Evidence:
        span = spans[person]
        own = Evidence.of(evidence.joints[span, person], covariance[span, person], fps, settings)
        for view in evidence.ray_constraints:
            points, across = view.points[span, person], view.across[span, person]
            own = own.add_rays(points, across, fps, settings)
        return own

    by_person = dict(zip(spans, map_in_threads(gather, spans), strict=True))
    return by_person, present


def random_covariance(covariance: Floats, common_bias: Floats) -> Floats:
    """Return the covariance of joints without most of the bias that the shared offsets model.

    It is that of joints where the detector sees them.

    Args:
        covariance: (..., 17, 3, 3) [m^2], of triangulated joints or of bodies.
        common_bias: (17,) per axis [m], included in `covariance`.
    """
    # 1 cm per axis stays; the shared offsets model the rest.
    modelled = np.maximum(common_bias**2 - 0.01**2, 0.0)
    random = covariance.astype(np.float64)
    for axis in range(3):
        random[..., axis, axis] -= modelled
    return random
