"""Tasks of stages `triangulation` and `retriangulation`: 3D joints of one clip."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import GroupLayout
from data_contracts.triangulation import (
    CLOCK_CHANGE,
    RETRIANGULATION,
    TRIANGULATION,
    CameraChange,
)
from tasks.clip_inputs import (
    ClipInputs,
    known_changes,
    open_tracked_clip,
    triangulation_settings,
)
from tasks.unit import UnitInputs, figures_of, unit_task
from worldpose.camera_consistency.changes import Kind, find_changes
from worldpose.camera_consistency.health import CameraHealth
from worldpose.store.writer import ResultWriter
from worldpose.triangulation.camera_changes import (
    change_record,
    describe_change,
    explain_changes,
    is_same_change,
)
from worldpose.triangulation.estimate import learn_clip, reconstruct_chunks
from worldpose.triangulation.results import DetectorModel, Smoothing, Triangulation
from worldpose.triangulation.settings import TriangulationSettings


@unit_task
def triangulation(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write joints with covariance."""
    settings = inputs.settings(TriangulationSettings)
    stride = settings.stride(inputs.sources["match_frames"])
    kinds: tuple[Kind, ...] = ("clock", "view") if stride == 1 else ("view",)
    _write_joints(inputs, settings, result, TRIANGULATION, kinds, stride)


@unit_task
def retriangulation(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the joints by adjusted cameras, with covariance."""
    settings = triangulation_settings(inputs, inputs.unit)
    first = inputs.open(f"triangulation/{inputs.unit}")
    kinds: tuple[Kind, ...] = () if first.sizes["frame"] == len(inputs.frames) else ("clock",)
    _write_joints(inputs, settings, result, RETRIANGULATION, kinds)


def _write_joints(
    inputs: UnitInputs,
    settings: TriangulationSettings,
    result: ResultWriter,
    layout: GroupLayout,
    kinds: tuple[Kind, ...],
    stride: int = 1,
) -> None:
    """Triangulate every `stride`-th frame of the unit's clip in chunks, and write the joints.

    The task searches for changes of cameras of these kinds, and keeps those that are known.
    """
    clip = open_tracked_clip(inputs)
    detections, covariance = clip.detections, camera_errors(inputs, clip)
    index = detections.detection_index
    model = learn_clip(clip.cameras, detections, clip.fps, settings, covariance)
    agreements, changes = [], []
    rows = np.arange(0, len(index), stride)
    _, cameras, persons = index.shape
    health = CameraHealth.empty(len(rows), cameras, persons, clip.fps / stride)
    with inputs.open_spool() as spool:
        chunks = reconstruct_chunks(
            clip.cameras, detections, model, clip.fps, settings, covariance, stride=stride
        )
        for part in chunks:
            spool.add(_part_arrays(part.triangulation, part.smoothing))
            if kinds:
                seen = detections[rows[part.frames]]
                health.add(clip.cameras, seen, part.triangulation.joints, part.frames.start)
            agreements.append(part.triangulation.agreement)
            changes.append(part.smoothing.changes)
        known = known_changes(inputs, inputs.unit)
        found = _find_changes(clip, health, kinds, settings, rows, known, result)
        result.write(
            layout,
            arrays=spool.arrays()
            | {"clock_late": model.clocks.late, "clock_error": model.clocks.standard_error}
            | _bias_arrays(model.detector, clip.detections.points, settings),
            coordinates={"frame": detections.frame[::stride], "person": clip.person},
            attributes={
                "camera": list(clip.camera_ids),
                "changes": [change.model_dump(mode="json") for change in found],
                **clip.detections.labels(),
            },
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


def _find_changes(
    clip: ClipInputs,
    health: CameraHealth,
    kinds: tuple[Kind, ...],
    settings: TriangulationSettings,
    rows: NDArray[np.int64],
    known: list[CameraChange],
    result: ResultWriter,
) -> list[CameraChange]:
    """Return the known changes and the clearest further one of a camera, and warn of that."""
    fps = clip.fps * len(rows) / max(1, len(clip.detections.frame))
    found = [
        replace(change, row=int(rows[change.row])) for change in find_changes(health, fps, kinds)
    ]
    if not found:
        return known
    if len(clip.camera_ids) < 3:
        when = f"at frame {clip.detections.frame[found[0].row]}" if found[0].is_sudden else "slowly"
        result.warnings.append(
            f"cameras {' and '.join(clip.camera_ids)} cease to agree {when}: one of them moved, or "
            "its clock changed. Two cameras cannot tell which."
        )
        return known
    measured = explain_changes(clip.cameras, clip.detections, clip.fps, settings, found, kinds)
    if measured is None:
        if np.median(health.misfit) > 3.0:
            result.warnings.append(
                "all cameras move within the clip, each in its own way, as electronic "
                "stabilisation does: no person agrees with the views. Turn it off, or give the "
                "videos without it."
            )
        return known
    camera = clip.camera_ids[measured.found.camera]
    change = change_record(measured, camera, clip.detections.frame)
    if any(is_same_change(other, change, clip.fps) for other in known):
        return known
    result.warnings.append(f"{describe_change(change)}.")
    if change.kind == "clock":
        result.figures[CLOCK_CHANGE + camera] = change.late_frames
    return [*known, change]


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
