"""Bodies of every person of a clip: shape, then position, orientation and angles per frame.

Quality metrics of a fit need no ground truth.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import Record
from worldpose.body import BodyModel, BodyParameters, fold_keypoints
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.model import BODY_POSE
from worldpose.body_fitting.bones import BONES, Shape
from worldpose.body_fitting.extra_points import ExtraFit, prepare_points
from worldpose.body_fitting.monocular import (
    CORRELATION_S,
    MonocularPoses,
    MonocularPrior,
    carry_errors,
    deviations,
    learn_precision,
)
from worldpose.body_fitting.objective import (
    ANKLES,
    Evidence,
    Ground,
    Pose,
    body_axes,
    perceived_joints,
)
from worldpose.body_fitting.pose_space import GATHER, load_pose_prior, nearest_known
from worldpose.body_fitting.ray_constraints import RayConstraints
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.solver import (
    Shapes,
    Solver,
    fit_shapes,
)
from worldpose.compiled import map_in_threads
from worldpose.errors import InputError
from worldpose.geometry import Camera
from worldpose.triangulation import ExtraJoints

MAX_DEVIATION: Final = 0.035
"""Joints are well determined if their median standard deviation per axis is below this [m]: 16
cameras leave 0.02 to 0.03, two 0.04 to 0.1."""
KEPT_BIAS: Final = 0.01
"""Part of the joints' common bias that stays in their covariance per axis [m]; the shared offsets
model the rest."""
MAX_OFFSET: Final = 3.0
"""Offsets beyond this are unusual for any detector [standard deviations]: one in 34."""


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


@dataclass(frozen=True, eq=False)
class ClipEvidence:
    """Evidence about the bodies of one clip.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world, COCO-17; NaN where missing.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`.
        fps: [1/s].
        common_bias: (17,) per axis, error that all views share [m]; `covariance` contains it. Body
            fitting does not reduce it: on real people (Shelf) joints of bodies are as far from the
            labels as triangulated joints. None = none.
        ray_constraints: lines of sight of joints that are not triangulated, for the same frames and
            persons; a person without joints is present as long as these last.
        monocular_poses: poses of the same frames and persons, used where few joints are well
            determined (S4).
        shared_covariance: (frames, persons, 3, 3) [m^2], the part of `covariance` that moves all
            joints of a person together: no number of joints reduces it. NaN = unknown in this
            frame; None = none.
        extra: points besides COCO-17 of the same frames and persons; None = none. They determine
            poses, those of the feet too, and no shapes.

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


def fit_bodies(
    model: BodyModel,
    evidence: ClipEvidence,
    settings: BodyFittingSettings = BodyFittingSettings(),  # noqa: B008
    ground: Ground | None = None,
    known_shapes: Mapping[int, Shape] | None = None,
) -> BodyFit:
    """Return the bodies that fit the triangulated joints of all persons (S1-S3).

    Shape starts from bone lengths, poses from hips and torso; then betas, coarse poses and the
    detector's shared offsets are estimated together, and last the poses of all frames with fixed
    betas and offsets.

    Args:
        model: the body.
        evidence: triangulated joints, and other observations of the same clip.
        settings: expected errors of detectors, bodies and motion.
        ground: height of the surface under the feet, in a world with z up; None where unknown.
        known_shapes: shapes of people from other clips, by their index in the joints.
    """
    joints, fps = evidence.joints, evidence.fps
    bias = np.zeros(17) if evidence.common_bias is None else evidence.common_bias
    covariance = random_covariance(evidence.covariance, bias)
    frames, persons = joints.shape[:2]
    solver = Solver(
        ChainedKeypoints.of(fold_keypoints(model, COCO17)), load_pose_prior(), settings, ground
    )
    joint_seen = np.asarray(np.isfinite(joints).all(-1) & np.isfinite(covariance).all((-1, -2)))
    seen = np.asarray(joint_seen.any(-1))
    spans = {
        person: slice(int(here[0]), int(here[-1]) + 1)
        for person in range(persons)
        if len(here := np.flatnonzero(seen[:, person]))
    }
    by_person, present = _gather_evidence(evidence, covariance, seen, spans, settings)
    shapes = fit_shapes(
        solver,
        {
            person: (joints[span, person], covariance[span, person])
            for person, span in spans.items()
        },
        known_shapes or {},
        fps,
    )
    result = FittedArrays.empty(model, frames, persons)
    extra = prepare_points(solver, evidence.extra, spans, by_person, shapes, fps)
    if extra is not None:
        solver, by_person = extra.solver, extra.people

    def fit_person(person: int, prior: MonocularPrior | None = None) -> None:
        own, span = by_person[person], spans[person]
        pose, points, random = solver.solve_windows(
            own, shapes.people[person], shapes.offsets, fps, prior
        )
        spread = random[:, :17] + bias[:, None, None] ** 2 * np.eye(3)
        determined = None if extra is None else extra.determined[person]
        own_joints = points[:, :17], spread
        bodies = result.put(solver, person, span, pose, own_joints, shapes, determined)
        if extra is not None:
            extra.put(person, span, bodies, random[:, 17:])

    for _ in map_in_threads(fit_person, spans):
        pass
    if evidence.monocular_poses is not None:
        priors = _monocular_priors(
            result, joint_seen, covariance, evidence.monocular_poses, spans, fps
        )
        for person, prior in priors.items():
            fit_person(person, prior)
            result.guided[spans[person], person] = prior.used
    for person, span in spans.items():
        result.filled[span, person] = ~seen[span, person]
        gone = _long_gaps(present[span, person], settings.max_filled_gap_s * fps)
        shared = evidence.shared_covariance
        for arrays in (result,) if extra is None else (result, extra):
            arrays.drop(person, span, gone)
            if shared is not None:
                arrays.covariance[span, person] += _nearest_known(shared[span, person])[:, None]
    fit = result.fit(shapes)
    return fit if extra is None else replace(fit, extra=extra.fit())


def _gather_evidence(
    evidence: ClipEvidence,
    covariance: Floats,
    seen: NDArray[np.bool_],
    spans: Mapping[int, slice],
    settings: BodyFittingSettings,
) -> tuple[dict[int, Evidence], NDArray[np.bool_]]:
    """Return each person's joints and lines of sight, and the frames (frames, persons) with any.

    Args:
        evidence: joints and lines of sight of the clip.
        covariance: (frames, persons, 17, 3, 3) [m^2], of the joints, without modelled bias.
        seen: (frames, persons), persons with a joint.
        spans: frames of each person.
        settings: scale and correlation time of the noise.
    """
    fps, present = evidence.fps, seen
    by_person = {
        person: Evidence.of(evidence.joints[span, person], covariance[span, person], fps, settings)
        for person, span in spans.items()
    }
    for view in evidence.ray_constraints:
        present = present | view.seen
        for person, span in spans.items():
            points, across = view.points[span, person], view.across[span, person]
            by_person[person] = by_person[person].add_rays(points, across, fps, settings)
    return by_person, present


def random_covariance(covariance: Floats, common_bias: Floats) -> Floats:
    """Return the covariance of joints without most of the bias that the shared offsets model.

    It is that of joints where the detector sees them.

    Args:
        covariance: (frames, persons, 17, 3, 3) [m^2], of triangulated joints or of bodies.
        common_bias: (17,) per axis [m], included in `covariance`.
    """
    modelled = np.maximum(common_bias**2 - KEPT_BIAS**2, 0.0)
    return covariance - modelled[:, None, None] * np.eye(3)


def _nearest_known(matrices: Floats) -> Floats:
    """Return matrices (frames, 3, 3) with those of the nearest frame where they are NaN."""
    known = np.flatnonzero(np.isfinite(matrices).all(axis=(-1, -2)))
    if not len(known):
        return np.zeros_like(matrices)
    nearest: Floats = matrices[nearest_known(known, np.arange(len(matrices)))]
    return nearest


def _monocular_priors(
    result: FittedArrays,
    joint_seen: NDArray[np.bool_],
    covariance: Floats,
    estimates: MonocularPoses,
    spans: Mapping[int, slice],
    fps: float,
) -> dict[int, MonocularPrior]:
    """Return monocular poses of persons for frames with few well-determined joints."""
    variance = np.trace(covariance[:, :, 5:], axis1=-2, axis2=-1) / 3.0
    sure = np.median(np.where(joint_seen[:, :, 5:], variance, np.inf), axis=-1) < MAX_DEVIATION**2
    correlated_frames = 1.0 + CORRELATION_S * fps
    angles = result.body_pose @ GATHER.T
    precision = learn_precision(estimates, result.orient, angles, sure, correlated_frames)
    there = np.isfinite(estimates.angles[..., 0])
    guided = {}
    for person, span in spans.items():
        used = (there & ~sure)[span, person]
        if not used.any():
            continue
        orient, bend = estimates.orient[span, person], estimates.angles[span, person]
        off = deviations(orient, bend, result.orient[span, person], angles[span, person])
        off[~(there & sure)[span, person]] = np.nan
        orient, bend, left = carry_errors(orient, bend, off, used, CORRELATION_S * fps)
        guided[person] = MonocularPrior(orient, bend, used, precision, correlated_frames, left)
    return guided


def _long_gaps(seen: NDArray[np.bool_], max_frames: float) -> NDArray[np.bool_]:
    """Return the frames in gaps of more than `max_frames` frames."""
    places = np.flatnonzero(seen)
    long = np.zeros(len(seen), dtype=bool)
    for first, last in itertools.pairwise(places):
        if last - first - 1 > max_frames:
            long[first + 1 : last] = True
    return long


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

    def fit(self, shapes: Shapes) -> BodyFit:
        """Return the complete fit."""
        betas = np.broadcast_to(self.betas, (*self.orient.shape[:2], self.betas.shape[-1]))
        parameters = BodyParameters(betas, self.orient, self.body_pose, self.transl)
        return BodyFit(
            self.betas,
            parameters,
            self.betas_covariance,
            self.joints,
            self.covariance,
            self.filled,
            self.guided,
            shapes.offsets,
        )


class BodyFittingReport(Record):
    """Metrics of one clip, and of each person in the order of the persons; None without data."""

    bodies: int
    """Fitted bodies, one per frame and person [1]."""
    filled: int
    """Fitted bodies in frames without any joint of the person [1]."""
    guided: int
    """Bodies fitted with a monocular pose [1]."""
    offset_rms_m: float
    """Root mean square offset per axis from a body's joint to the detector's [m]."""
    residual_m: tuple[float | None, ...]
    """Median distance of triangulated joints, minus those offsets, from the body's [m]."""
    reprojection_px: tuple[float | None, ...]
    """Median image distance of seen keypoints, minus those offsets, from the body's [px]; None
    without cameras."""
    bone_spread_m: tuple[float | None, ...]
    """Standard deviation of triangulated limbs' lengths, median over limbs [m]; bodies have 0."""
    skating_m: tuple[float | None, ...]
    """Median motion of an ankle per frame while it is slower than 0.5 m/s [m]."""
    jerk_m_s3: tuple[float | None, ...]
    """Root mean square third derivative of the body's keypoints [m/s^3]."""


def report_fit(
    fit: BodyFit,
    joints: Floats,
    fps: float,
    seen: tuple[Camera, KeypointDetections] | None = None,
) -> BodyFittingReport:
    """Return the metrics of a fit.

    Args:
        fit: bodies of one clip.
        joints: (frames, persons, 17, 3) [m], world, input of the fit.
        fps: [1/s].
        seen: static cameras (cameras,) and the detections behind the joints, left-right swaps
            undone.
    """
    perceived = perceived_joints(fit.joints, fit.offsets)
    away = np.linalg.norm(joints - perceived, axis=-1)
    step = np.linalg.norm(np.diff(fit.joints[:, :, ANKLES], axis=0), axis=-1)
    jerk = np.linalg.norm(np.diff(fit.joints, n=3, axis=0), axis=-1) * fps**3
    persons = range(joints.shape[1])
    ends = np.array(BONES)
    limbs = np.linalg.norm(joints[:, :, ends[:, 1]] - joints[:, :, ends[:, 0]], axis=-1)
    return BodyFittingReport(
        bodies=int(np.isfinite(fit.joints[:, :, 0, 0]).sum()),
        filled=int(fit.filled.sum()),
        guided=int(fit.guided.sum()),
        offset_rms_m=float(np.sqrt(np.mean(fit.offsets**2))),
        residual_m=tuple(_median(away[:, person]) for person in persons),
        reprojection_px=tuple(
            None if seen is None else _median(_reprojection(perceived, seen, person))
            for person in persons
        ),
        bone_spread_m=tuple(_spread(limbs[:, person]) for person in persons),
        skating_m=tuple(
            _median(np.where(step[:, person] * fps < 0.5, step[:, person], np.nan))
            for person in persons
        ),
        jerk_m_s3=tuple(_root_mean_square(jerk[:, person]) for person in persons),
    )


def _reprojection(
    perceived: Floats, seen: tuple[Camera, KeypointDetections], person: int
) -> Floats:
    """Return distances of one person's keypoints (frames, cameras, 17) [px]; NaN where not seen."""
    cameras, detections = seen
    place = detections.detection_index[:, :, person]
    frame, camera = np.nonzero(place >= 0)
    own = np.full((*place.shape, 17, 2), np.nan)
    own[frame, camera] = detections.keypoints[frame, camera, place[frame, camera]]
    image = cameras.project(perceived[:, None, person])
    return np.asarray(np.linalg.norm(image - own, axis=-1))


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _spread(lengths: Floats) -> float | None:
    spreads = [
        float(known.std()) for limb in lengths.T if len(known := limb[np.isfinite(limb)]) > 1
    ]
    return float(np.median(spreads)) if spreads else None


def _root_mean_square(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def far_offsets(offsets: Floats, common_bias: Floats) -> dict[str, tuple[float, float]]:
    """Return the joints of bodies with unusually large offsets.

    Shape and offsets together follow the detector: an offset much larger than a detector's common
    bias means that either the joints or the bodies are wrong.

    Args:
        offsets: (17, 3) [m], of joints of bodies.
        common_bias: (17,) per axis [m]; 0 = not known.

    Returns:
        By joint, left and right as one: length of the offset and its usual maximum [m].
    """
    length = np.linalg.norm(offsets, axis=-1)
    far = (length > MAX_OFFSET * common_bias) & (common_bias > 0.0)
    return {
        COCO17[joint].removeprefix("left_"): (
            float(length[joint]),
            MAX_OFFSET * float(common_bias[joint]),
        )
        for joint in np.flatnonzero(far)
        if not COCO17[joint].startswith("right")
    }
