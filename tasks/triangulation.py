"""Tasks of stages `triangulation` and `retriangulation`: 3D joints of one clip."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import GroupLayout
from data_contracts.triangulation import RETRIANGULATION, TRIANGULATION
from tasks.clip_inputs import ClipInputs, open_tracked_clip, triangulation_settings
from tasks.unit import UnitInputs, figures_of, unit_task
from worldpose.store.writer import ResultWriter
from worldpose.triangulation.estimate import learn_clip, reconstruct_chunks
from worldpose.triangulation.results import DetectorModel, Smoothing, Triangulation
from worldpose.triangulation.settings import TriangulationSettings


@unit_task
def triangulation(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write joints with covariance."""
    settings = inputs.settings(TriangulationSettings)
    stride = settings.stride(inputs.sources["match_frames"])
    _write_joints(inputs, settings, result, TRIANGULATION, stride)


@unit_task
def retriangulation(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the joints by adjusted cameras, with covariance."""
    settings = triangulation_settings(inputs, inputs.unit)
    _write_joints(inputs, settings, result, RETRIANGULATION)


def _write_joints(
    inputs: UnitInputs,
    settings: TriangulationSettings,
    result: ResultWriter,
    layout: GroupLayout,
    stride: int = 1,
) -> None:
    """Triangulate every `stride`-th frame of the unit's clip in chunks, and write the joints."""
    clip = open_tracked_clip(inputs)
    detections, covariance = clip.detections, camera_errors(inputs, clip)
    index = detections.detection_index
    model = learn_clip(clip.cameras, detections, clip.fps, settings, covariance)
    agreements, changes = [], []
    with inputs.open_spool() as spool:
        chunks = reconstruct_chunks(
            clip.cameras, detections, model, clip.fps, settings, covariance, stride=stride
        )
        for part in chunks:
            spool.add(_part_arrays(part.triangulation, part.smoothing))
            agreements.append(part.triangulation.agreement)
            changes.append(part.smoothing.changes)
        result.write(
            layout,
            arrays=spool.arrays()
            | {"clock_late": model.clocks.late, "clock_error": model.clocks.standard_error}
            | _bias_arrays(model.detector, clip.detections.points, settings),
            coordinates={"frame": detections.frame[::stride], "person": clip.person},
            attributes={"camera": list(clip.camera_ids), **clip.detections.labels()},
        )
    agreement = reduce(add, agreements).report(model.detector.last_noise.factor)
    if agreement.joints == 0 and index.shape[2]:
        most = int(np.count_nonzero(index >= 0, axis=1).max())
        reason = (
            f"no person is seen by more than {most} cameras at once and min_views asks for "
            f"{settings.min_views}"
            if most < settings.min_views
            else f"no {settings.min_views} views agree within max_deviation="
            f"{settings.max_deviation:g} at an angle of min_angle_rad={settings.min_angle_rad:g}"
        )
        result.warnings.append(
            f"{inputs.recipe.name} placed no joint of {index.shape[2]} people: {reason}."
        )
    for report in (
        agreement,
        reduce(add, changes).report(model.motion.acceleration, model.motion.repeated),
        model.clocks.report,
    ):
        result.figures.update(figures_of(report, clip.camera_ids))


def camera_errors(inputs: UnitInputs, clip: ClipInputs) -> NDArray[np.float64] | None:
    """Return each camera's covariance, (cameras, 12, 12); None from the second iteration on.

    Adjusted cameras have accurate relative poses, and a larger position error that all share.
    Treated as independent errors of the cameras, their covariances would displace people.
    Systematic errors of each camera are then estimated from the residuals between cameras.
    """
    return None if f"filtering/{inputs.unit}" in inputs else clip.camera_covariance


def _part_arrays(joints: Triangulation, smooth: Smoothing) -> dict[str, NDArray[Any]]:
    """Return the stored arrays with a frame dimension."""
    extra: dict[str, NDArray[Any]] = {}
    if joints.extra is not None:
        extra = {
            "extra_joints": joints.extra.joints,
            "extra_covariance": joints.extra.covariance,
            "extra_views": joints.extra.views,
        }
    return extra | {
        "joints": joints.joints,
        "covariance": joints.covariance,
        "shared_covariance": joints.shared_covariance,
        "views": joints.views,
        "spread": joints.spread,
        "reprojection_error": joints.reprojection_error,
        "inliers": joints.inliers,
        "exchanged": joints.exchanged,
        "offsets": joints.offsets.astype("float32"),
        "smoothed": smooth.joints,
        "smoothed_covariance": smooth.covariance,
        "filled": smooth.filled,
    }


def _bias_arrays(
    detector: DetectorModel, points: tuple[str, ...], settings: TriangulationSettings
) -> dict[str, NDArray[Any]]:
    """Return the stored errors that all views share."""
    arrays: dict[str, NDArray[Any]] = {"common_bias": detector.common_bias}
    if points:
        arrays["extra_common_bias"] = np.full(len(points), settings.common_bias_m)
    return arrays
