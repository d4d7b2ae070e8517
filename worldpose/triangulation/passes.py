"""Triangulation of every joint of every person, in passes (T3, T4).

Each pass solves all joints (`solving`) and learns from the residuals: noise, left-right swaps,
calibration's share, offsets of people. The next pass uses it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.limb_lengths import (
    find_swaps,
    limb_lengths,
    repair_limb_lengths,
    undo_swaps,
)
from worldpose.triangulation.noise_model import BY_JOINT, NoiseModel, learn_common_bias, learn_noise
from worldpose.triangulation.observations import Observations, Rig, no_shift
from worldpose.triangulation.person_offsets import (
    estimate_midhip_shift,
    estimate_offsets,
    learn_factor,
    stated_errors,
)
from worldpose.triangulation.reports import Agreement, Histogram, TriangulationReport
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solving import Solution, solve_joints


@dataclass(frozen=True, eq=False)
class DetectorModel:
    """Error model of a clip's detector and calibration.

    Attributes:
        noise: noise model of each pass: without calibration's share, with it, and without the
            offsets.
        factor: on the stated variance of calibration.
        lengths: (persons, limbs) [m], limb lengths; NaN where unknown.
        common_bias: (joints,) per axis, error that all views share [m].
        extra_noise: noise model of points besides COCO-17; None without any.
    """

    noise: tuple[NoiseModel, ...]
    factor: float
    lengths: Floats
    common_bias: Floats
    extra_noise: NoiseModel | None = None

    def select_person(self, person: int) -> DetectorModel:
        """Return the model for one person alone."""
        return replace(self, lengths=self.lengths[person : person + 1])


@dataclass(frozen=True, eq=False)
class ExtraJoints:
    """Points besides COCO-17 in 3D, with covariance.

    Attributes:
        points: (points,) names.
        joints: (frames, persons, points, 3) [m], world; NaN where not determined.
        covariance: (frames, persons, points, 3, 3) [m^2], of `joints`: noise from their residuals,
            calibration, and the bias that all views share.
        views: (frames, persons, points) uint8, inlier cameras; 0 where not determined.
        common_bias: (points,) per axis, error that all views share [m]; in `covariance`.
    """

    points: tuple[str, ...]
    joints: Floats
    covariance: Floats
    views: NDArray[np.uint8]
    common_bias: Floats

    @classmethod
    def concatenate(cls, parts: Sequence[ExtraJoints]) -> ExtraJoints:
        """Return the points of consecutive parts of a clip."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("joints", "covariance", "views")
        }
        return replace(parts[0], **arrays)

    def __getitem__(self, frames: slice) -> ExtraJoints:
        """Return the points in some frames."""
        arrays: dict[str, Any] = {
            name: getattr(self, name)[frames] for name in ("joints", "covariance", "views")
        }
        return replace(self, **arrays)


@dataclass(frozen=True)
class Triangulation:
    """3D joints with covariance.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where not determined.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`: noise from the residuals,
            calibration, and the bias that all views share.
        views: (frames, persons, 17) uint8, inlier cameras; 0 where not determined.
        spread: (frames, persons, 17) float32 [rad], widest angle between inlier rays, at most a
            right angle; NaN where not determined.
        reprojection_error: (frames, persons, 17) float32 [px], root mean square length over the
            inlier cameras, offsets subtracted.
        inliers: (frames, cameras, persons, 17) bool, whether this camera is an inlier.
        exchanged: (frames, cameras, persons, 3) bool, left-right swaps of the detection's
            `EXCHANGED_PARTS`, already corrected.
        offsets: (frames, cameras, persons, 2) [px], offset of the person in the image from the
            reprojection of all cameras' joints; 0 where unknown.
        calibration_covariance: (frames, persons, 17, 3, 3) [m^2], the part of `covariance` that
            more frames do not reduce: offsets and the common bias.
        common_bias: (17,) per axis, error that all views share [m]; included in `covariance`.
        noise: noise model of the detector.
        agreement: counts and histograms behind `report`.
        extra: points besides COCO-17, which influence none of the above; None without any.
    """

    joints: Floats
    covariance: Floats
    views: NDArray[np.uint8]
    spread: NDArray[np.float32]
    reprojection_error: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    exchanged: NDArray[np.bool_]
    offsets: Floats
    calibration_covariance: Floats
    common_bias: Floats
    noise: NoiseModel
    agreement: Agreement
    extra: ExtraJoints | None = None

    @property
    def shared_covariance(self) -> Floats:
        """(frames, persons, 3, 3) [m^2], the part of `covariance` that moves all joints together.

        It is that of calibration, mean over the joints; NaN for a person without any.
        """
        found = np.asarray(np.isfinite(self.joints).all(-1))
        own = self.calibration_covariance - self.common_bias[:, None, None] ** 2 * np.eye(3)
        count = found.sum(-1)[..., None, None]
        total = np.where(found[..., None, None], own, 0.0).sum(axis=2)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def report(self) -> TriangulationReport:
        """The metrics of these frames."""
        return self.agreement.report(self.noise.factor)


def concatenate_frames(parts: Sequence[Triangulation]) -> Triangulation:
    """Return the triangulation of consecutive parts of a clip, which have one model."""
    # Attributes of `Triangulation` with a dimension of frames.
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in (
            "joints",
            "covariance",
            "views",
            "spread",
            "reprojection_error",
            "inliers",
            "exchanged",
            "offsets",
            "calibration_covariance",
        )
    }
    extra = [part.extra for part in parts if part.extra is not None]
    return replace(
        parts[0],
        **arrays,
        agreement=reduce(add, (part.agreement for part in parts)),
        extra=ExtraJoints.concatenate(extra) if extra else None,
    )


def triangulate_joints(
    cameras: Camera,
    detections: KeypointDetections,
    settings: TriangulationSettings = TriangulationSettings(),  # noqa: B008
    camera_covariance: Floats | None = None,
    model: DetectorModel | None = None,
) -> Triangulation:
    """Return every joint of every tracked person, triangulated from its inlier views.

    Each joint is the weighted least-squares point on reprojection over the inlier cameras
    (`consensus`). Nothing is filled in. Frames influence each other only through the model, which
    is learned from frames all over the clip.

    Args:
        cameras: batch (cameras,).
        detections: detections of all tracked people.
        settings: noise, inlier limit and minimum views.
        camera_covariance: (cameras, 12, 12) covariance of steps in the order of
            `static_calibration.parameters.PARAMETERS`; None = not known.
        model: result of `learn_detector` for the clip of these frames; None = these frames are the
            clip.

    Raises:
        InputError: the shapes do not match.

    Note:
        T3, T4. Residuals are pixels to first order in their length: the lens is linearised at the
        observation, accurate enough for any inlier residual.
    """
    check_shapes(cameras, detections, camera_covariance)
    if model is None and (
        settings.learn_noise or settings.offsets == "body" or settings.repair_limb_lengths
    ):
        chosen = sample_frames(detections.detection_index.shape, detections.confidence.shape[-1])
        model = learn_detector(cameras, detections[chosen], settings, camera_covariance)
    passes = _run_passes(cameras, detections, settings, camera_covariance, model)
    solution, shift, noise = passes.solution, passes.shift, passes.model.noise[-1]
    bias = passes.model.common_bias
    lasting = np.broadcast_to(
        passes.offset_covariance + bias[:, None, None] ** 2 * np.eye(3), solution.covariance.shape
    )
    covariance = solution.covariance + lasting
    found = Triangulation(
        joints=solution.joints,
        covariance=covariance,
        views=solution.views,
        spread=solution.spread,
        reprojection_error=solution.reprojection_error,
        inliers=solution.inliers,
        exchanged=passes.exchanged,
        offsets=shift[..., :2] if len(shift) else np.zeros((*detections.detection_index.shape, 2)),
        calibration_covariance=lasting,
        common_bias=bias,
        noise=noise,
        agreement=_count_agreement(passes, covariance, detections.detection_index),
    )
    if passes.extra is None:
        return found
    # Calibration moves all points of a person together, as it does the joints.
    shared = np.nan_to_num(found.shared_covariance) + settings.common_bias_m**2 * np.eye(3)
    extra = ExtraJoints(
        detections.points,
        passes.extra.joints,
        passes.extra.covariance + shared[:, :, None],
        passes.extra.views,
        np.full(len(detections.points), settings.common_bias_m),
    )
    return replace(found, extra=extra)


def sample_frames(shape: tuple[int, ...], joints: int) -> NDArray[np.int64]:
    """Return frames all over a clip of `shape` (frames, cameras, persons) to learn from."""
    frames, _, persons = shape
    # A confidence class then has thousands of observations.
    number = min(frames, 1 + 6000 // max(1, persons * joints))
    return np.unique(np.linspace(0, frames - 1, number).astype(np.int64))


def learn_detector(
    cameras: Camera,
    detections: KeypointDetections,
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
) -> DetectorModel:
    """Return the error model from sample frames; arguments as in `triangulate_joints`."""
    return _run_passes(cameras, detections, settings, camera_covariance, None).model


@dataclass(frozen=True, eq=False)
class _Passes:
    """Last solution with intermediate results."""

    solution: Solution
    exchanged: NDArray[np.bool_]
    shift: Floats
    offset_covariance: Floats | float
    model: DetectorModel
    misplaced: tuple[Histogram, ...]
    extra: Solution | None


def _run_passes(
    cameras: Camera,
    detections: KeypointDetections,
    settings: TriangulationSettings,
    camera_covariance: Floats | None,
    known: DetectorModel | None,
) -> _Passes:
    """Solve, and solve again with the learned calibration variance and offsets."""
    rig, limit = Rig.from_cameras(cameras), settings.max_deviation**2
    models: list[NoiseModel] = []

    def observe(shift: Floats) -> Observations:
        precision = models[-1].precision(detections.confidence)
        index = detections.detection_index
        return Observations.from_rig(rig, detections.keypoints, precision, index, shift)

    def observe_in_next_pass(shift: Floats) -> Observations:
        if known is not None:
            models.append(known.noise[len(models)])
        elif settings.learn_noise:
            models.append(learn_noise(rig, detections, shift, settings.noise, limit))
        else:
            models.append(NoiseModel.nominal(detections.confidence.shape[-1]))
        return observe(shift)

    shift = no_shift()
    if settings.offsets == "midhip":
        shift = estimate_midhip_shift(rig, detections, settings)
    observations = observe_in_next_pass(shift)
    solution = solve_joints(observations, settings)
    calibration = None if settings.offsets == "midhip" else camera_covariance
    exchanged = np.zeros((*detections.detection_index.shape, len(EXCHANGED_PARTS)), np.bool_)
    if settings.undo_swaps:
        exchanged = find_swaps(observations, settings.noise, limit, solution)
        detections = undo_swaps(detections, exchanged)
        observations = observe(shift)
        if exchanged.any() and calibration is None:
            solution = solve_joints(observations, settings)
    offset_covariance: Floats | float = 0.0
    misplaced = (Histogram.of(np.empty(0)),) * len(rig.cameras)
    factor = 1.0 if known is None else known.factor
    if calibration is not None:
        stated = stated_errors(cameras, solution.joints, settings, calibration)
        # Calibration errors are not detector noise, nor a reason to reject a view.
        shift = np.zeros((*stated.variance.shape, 3))
        shift[..., 2] = stated.variance
        observations = observe_in_next_pass(shift)
        solution = solve_joints(observations, settings)
    if settings.offsets == "body":
        stated = stated_errors(cameras, solution.joints, settings, camera_covariance)
        if known is None and camera_covariance is None:
            factor = learn_factor(observations, settings.noise, solution, stated.variance)
        variance = factor * stated.variance
        shift, offset_covariance = estimate_offsets(
            observations, settings.noise, solution, variance
        )
        misplaced = stated.position_std(factor)
        observations = observe_in_next_pass(shift)
        solution = solve_joints(observations, settings)
    lengths = limb_lengths(solution) if known is None else known.lengths
    if settings.repair_limb_lengths:
        repair_limb_lengths(observations, settings, solution, lengths)
    bias = np.full(detections.confidence.shape[-1], settings.common_bias_m)
    if known is not None:
        bias = known.common_bias
    elif settings.learn_noise and len(bias) == len(BY_JOINT):
        seen_noise = solution.covariance + offset_covariance
        bias = BY_JOINT * learn_common_bias(solution.joints, seen_noise, settings.common_bias_m)
    extra, extra_noise = None, None
    if detections.points:
        points = detections.select_points()
        extra_noise = NoiseModel.nominal(len(detections.points))
        if known is not None and known.extra_noise is not None:
            extra_noise = known.extra_noise
        elif settings.learn_noise:
            extra_noise = learn_noise(rig, points, shift, settings.noise, limit)
        precision = extra_noise.precision(points.confidence)
        extra = solve_joints(
            Observations.from_rig(
                rig, points.keypoints, precision, detections.detection_index, shift
            ),
            settings,
        )
    model = DetectorModel(tuple(models), factor, lengths, bias, extra_noise)
    return _Passes(solution, exchanged, shift, offset_covariance, model, misplaced, extra)


def _count_agreement(passes: _Passes, covariance: Floats, index: NDArray[np.integer]) -> Agreement:
    """Return the agreement between the views of some frames."""
    solution = passes.solution
    views, seen = solution.views, solution.seen
    found = views > 0
    used = seen & found[:, None]
    trace = np.einsum("...ii", covariance)[found]
    return Agreement(
        found=int(found.sum()),
        undetermined=int((seen.any(axis=1) & ~found).sum()),
        seen=int(np.count_nonzero(seen)),
        views=int(views[found].sum(dtype=np.int64)),
        used=_by_camera(used),
        agreed=_by_camera(solution.inliers),
        error=Histogram.of(solution.reprojection_error[found]),
        deviation=Histogram.of(np.sqrt(trace)),
        people=_by_camera(np.asarray(index >= 0)),
        exchanged=_by_camera(np.asarray(passes.exchanged.any(axis=-1))),
        misplaced=passes.misplaced,
    )


def _by_camera(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of true entries of (frames, cameras, ...), by camera."""
    return np.array([np.count_nonzero(there[:, c]) for c in range(there.shape[1])], np.int64)


def check_shapes(
    cameras: Camera, detections: KeypointDetections, camera_covariance: Floats | None
) -> None:
    """Require arrays of matching shapes, and valid indices.

    Raises:
        InputError: shapes do not match, or an index is invalid.
    """
    keypoints, confidence = detections.keypoints, detections.confidence
    detection_index = detections.detection_index
    if (
        confidence.ndim != 4
        or keypoints.shape != (*confidence.shape, 2)
        or detection_index.ndim != 3
        or detection_index.shape[:2] != confidence.shape[:2]
        or cameras.batch_shape != confidence.shape[1:2]
    ):
        raise InputError(
            "triangulation",
            expected="keypoints (frames, cameras, detections, joints, 2), confidence without the "
            "last, detection_index (frames, cameras, persons), cameras (cameras,)",
            found=f"{keypoints.shape}, {confidence.shape}, {detection_index.shape}, "
            f"{cameras.batch_shape}",
            todo="Give arrays of the same clip and cameras.",
        )
    if camera_covariance is not None and camera_covariance.shape != (*cameras.batch_shape, 12, 12):
        raise InputError(
            "triangulation: camera_covariance",
            expected=f"shape {(*cameras.batch_shape, 12, 12)}",
            found=f"{camera_covariance.shape}",
            todo="Give the covariance of every camera's calibration, or none.",
        )
    detections = confidence.shape[2]
    if (
        detection_index.size
        and not -1 <= detection_index.min() <= detection_index.max() < detections
    ):
        raise InputError(
            "triangulation: detection_index",
            expected=f"-1 or the place of one of {detections} detections",
            found=f"{detection_index.min()} to {detection_index.max()}",
            todo="Give the index that was made from these detections.",
        )
