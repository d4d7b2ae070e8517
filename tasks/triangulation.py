"""Tasks of stages `triangulation` and `retriangulation`: 3D joints of one clip."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, GroupLayout
from data_contracts.triangulation import (
    CLOCK_CHANGE,
    HEALTH_MEASURES,
    RETRIANGULATION,
    TRIANGULATION,
    CameraChange,
)
from tasks.clip_inputs import (
    ClipInputs,
    known_changes,
    open_tracked_clip,
    select_frames,
    triangulation_settings,
)
from tasks.unit import UnitInputs, figures_of, unit_task
from worldpose.camera_consistency.health import CameraHealth, judge_health, measure_health
from worldpose.ingest.footage import stretches
from worldpose.store.writer import ResultWriter
from worldpose.triangulation.camera_changes import describe_change, find_changes
from worldpose.triangulation.change_search import add_changes
from worldpose.triangulation.change_sums import ChangeSums, Kind, choose_bins, sum_joints
from worldpose.triangulation.estimate import learn_clip, reconstruct_chunks
from worldpose.triangulation.person_offsets import stated_errors
from worldpose.triangulation.results import Smoothing, Triangulation
from worldpose.triangulation.settings import TriangulationSettings

UNHEALTHY: Final = "unhealthy_share"
"""Metric: share of the clip in which a camera is not healthy, of the worst one [1]."""


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
    agreements, changes, sums = [], [], []
    rows = np.arange(0, len(index), stride)
    _, cameras, persons = index.shape
    fps = clip.fps / stride
    health = CameraHealth.empty(len(rows), cameras, persons, fps)
    bins = choose_bins(len(rows) * cameras * persons, fps)
    stated = None
    if covariance is not None:

        def stated(joints: Floats) -> Floats:
            return stated_errors(clip.cameras, joints, settings, covariance).variance

    with inputs.open_spool() as spool:
        chunks = reconstruct_chunks(
            clip.cameras, detections, model, clip.fps, settings, covariance, stride=stride
        )
        for part in chunks:
            spool.add(_part_arrays(part.triangulation, part.smoothing))
            seen = detections[rows[part.frames]]
            joints = part.triangulation.joints
            health.add(clip.cameras, seen, joints, part.frames.start, stated)
            sums.append(sum_joints(clip.cameras, seen, joints, part.frames.start, fps, bins))
            agreements.append(part.triangulation.agreement)
            changes.append(part.smoothing.changes)
        equations = ChangeSums.join(sums, clip.cameras, fps)
        measured = _health_arrays(inputs, clip, health, equations, rows, result)
        found = _find_changes(inputs, clip, health, equations, kinds, rows, result)
        bias = np.full(len(detections.points), settings.common_bias_m)
        result.write(
            layout,
            arrays=spool.arrays()
            | {"clock_late": model.clocks.late, "clock_error": model.clocks.standard_error}
            | measured
            | {"common_bias": model.detector.common_bias}
            | ({"extra_common_bias": bias} if len(bias) else {}),
            coordinates={"frame": detections.frame[::stride], "person": clip.person},
            attributes={
                "camera": list(clip.camera_ids),
                "changes": [change.model_dump(mode="json") for change in found],
                **clip.detections.labels(),
            },
        )
    agreement = reduce(add, agreements).report(model.detector.last_noise.factor)
    if agreement.joints == 0 and index.shape[2]:
        result.warnings.append(_explain_absence(inputs.recipe.name, index, settings))
    result.figures.update(figures_of(agreement, clip.camera_ids))
    if agreement.joints:  # motion and clocks are assumed without any, not measured
        moved = reduce(add, changes).report(model.motion.acceleration, model.motion.repeated)
        for report in (moved, model.clocks.report):
            result.figures.update(figures_of(report, clip.camera_ids))


def _explain_absence(
    stage: str, index: NDArray[np.integer], settings: TriangulationSettings
) -> str:
    """Return why no joint of tracked people (frames, cameras, persons) is placed."""
    most = int(np.count_nonzero(index >= 0, axis=1).max())
    reason = (
        f"no person is seen by more than {most} cameras at once and min_views asks for "
        f"{settings.min_views}"
        if most < settings.min_views
        else f"no {settings.min_views} views agree within max_deviation="
        f"{settings.max_deviation:g} at an angle of min_angle_rad={settings.min_angle_rad:g}"
    )
    return f"{stage} placed no joint of {index.shape[2]} people: {reason}."


def _health_arrays(
    inputs: UnitInputs,
    clip: ClipInputs,
    health: CameraHealth,
    equations: ChangeSums,
    rows: NDArray[np.int64],
    result: ResultWriter,
) -> dict[str, NDArray[Any]]:
    """Return the stored health of cameras over time, and write its metrics."""
    frame, score = clip.detections.frame, clip.detections.score
    index = inputs.open(f"tracking/{inputs.unit}")["detection_index"].values
    count = np.concatenate(
        [np.isfinite(score[rows[k : k + 512]]).sum(axis=2) for k in range(0, len(rows), 512)]
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        unmatched = 1.0 - np.count_nonzero(index[rows] >= 0, axis=2) / count
    measures = {"unmatched": np.where(count > 0, unmatched, np.nan)}
    filmed = [select_frames(inputs.open(name), frame[rows]) for name in inputs.sources["seen"]]
    unknown = np.full(len(rows), np.nan)
    for name in ("brightness", "sharpness"):
        measures[name] = np.stack([each.get(name, unknown) for each in filmed], axis=1)
    has_images = np.array(["brightness" in each for each in filmed])
    # A camera may film other clips alone.
    has_images = has_images & ~np.isnan(measures["brightness"]).all(axis=0)
    measures["missing"] = np.where(has_images, np.isnan(measures["brightness"]), np.nan)
    departures = equations.departures(clip.cameras, len(health.sums), health.length)
    values = measure_health(health, departures, measures)
    if len(rows) < len(frame):
        values[..., HEALTH_MEASURES.index("clock_frames")] = np.nan  # people move too far
    begun = np.asarray(frame[rows][:: health.length], dtype=np.int64)
    bad = judge_health(values) > 1.0
    shares = bad.mean(axis=0).tolist()
    each = {
        f"{UNHEALTHY}.{name}": share for name, share in zip(clip.camera_ids, shares, strict=True)
    }
    result.figures |= {UNHEALTHY: max(shares, default=0.0), **each}
    missed = health.missed * health.every / max(1, len(rows))
    for name, persons in zip(clip.camera_ids, missed if missed.size else (), strict=False):
        worst = int(persons.argmax())
        result.figures |= {
            f"missed_share.{name}": float(persons[worst]),
            f"missed_person.{name}": float(clip.person[worst]),
        }
    ends = np.append(begun, frame[-1] + 1)[1:] - 1
    for camera, name in enumerate(clip.camera_ids):
        times = stretches(np.flatnonzero(bad[:, camera]))
        if times:
            first, last = max(times, key=lambda each: each[1] - each[0])
            result.figures |= {
                f"unhealthy_s.{name}": float(ends[last] + 1 - begun[first]) / clip.fps,
                f"unhealthy_from_frame.{name}": float(begun[first]),
                f"unhealthy_to_frame.{name}": float(ends[last]),
            }
    return {"health": values.astype(np.float32), "health_frame": begun}


def _find_changes(
    inputs: UnitInputs,
    clip: ClipInputs,
    health: CameraHealth,
    sums: ChangeSums,
    kinds: tuple[Kind, ...],
    rows: NDArray[np.int64],
    result: ResultWriter,
) -> list[CameraChange]:
    """Return the changes of cameras, the known ones and further ones; warn of these."""
    names, frame, warnings = clip.camera_ids, clip.detections.frame, result.warnings
    known = known_changes(inputs, inputs.unit)
    found = find_changes(clip.cameras, clip.detections, sums.fps, rows, sums, kinds)
    if found and len(names) < 3:
        row = found[0].row
        when = "slowly" if row is None else f"at frame {frame[row]}"
        warnings.append(
            f"cameras {' and '.join(names)} cease to agree {when}: one of them moved, or its clock "
            "changed. Two cameras cannot tell which."
        )
        return known
    known, new = add_changes(known, found, names, clip.cameras, frame, clip.fps)
    has_clocks = any(each.kind == "clock" for each in known)  # they are not taken back
    if not new and not has_clocks and np.median(health.misfit) > 3.0:
        warnings.append(
            "no person agrees with the views: all cameras move within the clip, each in "
            "its own way, as electronic stabilisation does, or the 2D poses or the "
            "calibration are wrong. Give videos without stabilisation, or better 2D poses."
        )
    warnings += [f"{describe_change(change)}." for change in new]
    clocks = [change for change in (*known, *new) if change.kind == "clock"]
    clocks.sort(key=lambda each: abs(each.late_frames))  # the largest of a camera stays
    result.figures |= {CLOCK_CHANGE + each.camera: each.late_frames for each in clocks}
    unexplained = {each.camera for each in new if not each.is_explained}
    spoilt = sorted(unexplained | {each.camera for each in clocks})
    if len(names) - len(spoilt) < 3 < len(names):
        warnings.append(f"changes of other cameras can hide behind those of {', '.join(spoilt)}.")
    return [*known, *new]


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
