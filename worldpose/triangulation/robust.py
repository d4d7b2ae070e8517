"""Robust weighted triangulation of every joint of every person (T3, T4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.records import Record
from worldpose.cameras import Camera
from worldpose.triangulation.array_checks import check_arrays
from worldpose.triangulation.calibration_errors import stated_errors
from worldpose.triangulation.midhip import midhip_shift
from worldpose.triangulation.noise_model import NoiseModel, learn_noise
from worldpose.triangulation.observations import Rig
from worldpose.triangulation.offsets import estimate_offsets
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solving import Solution, no_shift, solve

Floats = NDArray[np.float64]


class TriangulationReport(Record):
    """How well the views of a clip agree."""

    joints: int
    """Joints found [1]."""
    undetermined: int
    """Joints that some camera saw and that are missing all the same [1]."""
    observations: int
    """Keypoints of tracked people [1]."""
    rejected_share: tuple[float | None, ...]
    """Share of each camera's keypoints, among joints found, that disagree; None without any."""
    mean_views: float | None
    """Mean number of agreeing views of the joints found."""
    reprojection_error_px: float | None
    """Median over joints [px]."""
    standard_deviation_m: float | None
    """Median over joints of the root of the covariance's trace [m]."""
    noise_factor: float
    """Median over joints of the learned noise of a confident keypoint over the stated one [1]."""
    misplacement_m: tuple[float | None, ...]
    """By how much each camera misplaces people, root mean square per axis at the median person
    [m]; None where it sees nobody or offsets are off."""


@dataclass(frozen=True)
class Triangulation:
    """Joints in the world, and how sure they are.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where not determined.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints`: the noise that the residuals
            show, calibration, and the bias that all views share.
        views: (frames, persons, 17) uint8, agreeing cameras; 0 where not determined.
        spread: (frames, persons, 17) float32 [rad], widest angle between agreeing rays, at most a
            right one; NaN where not determined.
        reprojection_error: (frames, persons, 17) float32 [px], root mean square length over the
            agreeing cameras, offsets taken off.
        inliers: (frames, cameras, persons, 17) bool, does this camera agree.
        offsets: (frames, cameras, persons, 2) [px], by how much the camera sees the person beside
            where all cameras put him; 0 where unknown.
        calibration_covariance: (frames, persons, 17, 3, 3) [m^2], the part of `covariance` that
            observations of more frames do not lessen: offsets and the shared bias.
        noise: what the detector's errors were taken to be.
        report: figures for the whole clip.
    """

    joints: Floats
    covariance: Floats
    views: NDArray[np.uint8]
    spread: NDArray[np.float32]
    reprojection_error: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    offsets: Floats
    calibration_covariance: Floats
    noise: NoiseModel
    report: TriangulationReport


def triangulate_joints(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    detection_index: NDArray[np.int16],
    settings: TriangulationSettings,
    camera_covariance: Floats | None = None,
) -> Triangulation:
    """Return every joint of every tracked person where the views that agree put it.

    Each joint is the weighted least-squares point on reprojection over the cameras that agree
    (`consensus`). Nothing is filled in.

    Args:
        cameras: batch (cameras,).
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17) in (0, 1]; NaN, 0 or less leaves a keypoint
            out.
        detection_index: (frames, cameras, persons), place among the detections; -1 = not seen.
        settings: noise, agreement and least views.
        camera_covariance: (cameras, 12, 12) of steps in the order of
            `static_calibration.parameters.PARAMETERS`; None = not known.

    Raises:
        InputError: the shapes do not fit together.

    Note:
        T3, T4. Residuals are pixels to first order in their length: the lens is linearised at the
        observation, exact enough for any residual that can agree.
    """
    check_arrays(cameras, keypoints, confidence, detection_index, camera_covariance)
    rig, limit = Rig.of(cameras), settings.max_deviation**2

    def modelled(shift: Floats) -> NoiseModel:
        if not settings.learn_noise:
            return NoiseModel.stated(confidence.shape[-1])
        at = (rig, keypoints, confidence, detection_index, shift)
        return learn_noise(*at, settings.noise, limit)

    def solved(shift: Floats) -> tuple[NoiseModel, Solution]:
        model = modelled(shift)
        precision = model.precision(confidence)
        return model, solve(rig, keypoints, precision, detection_index, shift, settings)

    shift = no_shift()
    if settings.offsets == "midhip":
        shift = midhip_shift(rig, keypoints, confidence, detection_index, settings)
    model, solution = solved(shift)
    further: Floats | float = 0.0
    misplaced: tuple[float | None, ...] = (None,) * len(rig.cameras)
    if camera_covariance is not None and settings.offsets != "midhip":
        stated = stated_errors(cameras, solution.joints, settings, camera_covariance)
        # What calibration explains is not the detector's noise, nor a reason to reject a view.
        shift = np.zeros((*stated.variance.shape, 3))
        shift[..., 2] = stated.variance
        model, solution = solved(shift)
    if settings.offsets == "body":
        stated = stated_errors(cameras, solution.joints, settings, camera_covariance)
        at = (rig, keypoints, model.precision(confidence), detection_index)
        learn = camera_covariance is None
        found = estimate_offsets(*at, settings.noise, solution, stated.variance, learn)
        shift, further = found.shift, found.covariance
        misplaced = stated.misplacement(found.factor)
        model, solution = solved(shift)
    offsets = shift[..., :2] if len(shift) else np.zeros((*detection_index.shape, 2))
    lasting = np.broadcast_to(
        further + settings.common_bias**2 * np.eye(3), solution.covariance.shape
    )
    covariance = solution.covariance + lasting
    return Triangulation(
        joints=solution.joints,
        covariance=covariance,
        views=solution.views,
        spread=solution.spread,
        reprojection_error=solution.reprojection_error,
        inliers=solution.inliers,
        offsets=offsets,
        calibration_covariance=lasting,
        noise=model,
        report=_report(solution, covariance, model, misplaced),
    )


def _report(
    solution: Solution,
    covariance: Floats,
    model: NoiseModel,
    misplaced: tuple[float | None, ...],
) -> TriangulationReport:
    """Return the clip's figures from its arrays."""
    views, seen = solution.views, solution.seen
    found = views > 0
    used = seen & found[:, None]
    observations = used.sum(axis=(0, 2, 3)).tolist()
    agreed = solution.inliers.sum(axis=(0, 2, 3)).tolist()
    trace = np.trace(covariance[found], axis1=-2, axis2=-1)
    some = bool(found.any())
    error = solution.reprojection_error[found]
    return TriangulationReport(
        joints=int(found.sum()),
        undetermined=int((seen.any(axis=1) & ~found).sum()),
        observations=int(seen.sum()),
        rejected_share=tuple(
            1.0 - a / n if n else None for a, n in zip(agreed, observations, strict=True)
        ),
        mean_views=float(views[found].mean()) if some else None,
        reprojection_error_px=float(np.median(error)) if some else None,
        standard_deviation_m=float(np.median(np.sqrt(trace))) if some else None,
        noise_factor=float(np.median(np.sqrt(model.joint / model.precision_at[-1]))),
        misplacement_m=misplaced,
    )
