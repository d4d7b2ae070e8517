"""Task of stage `triangulation`: 3D joints of one clip."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import GroupLayout
from data_contracts.triangulation import TRIANGULATION
from data_contracts.work import Recipe, Work
from tasks.clip_inputs import ClipInputs, open_clip
from tasks.spool import open_spool
from tasks.unit import figures_of, open_input, unit_task
from worldpose.review.identities import select_triangulated
from worldpose.store.store import Store
from worldpose.store.writer import ResultWriter
from worldpose.triangulation.chunking import learn_clip, reconstruct_chunks
from worldpose.triangulation.clocks import CameraClocks
from worldpose.triangulation.passes import DetectorModel, Triangulation
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import Smoothing


@unit_task
def triangulation(work: Work) -> str:
    """Publish joints with covariance; return the key."""
    store = Store.open(work.project)
    with store.publish(work) as result:
        settings = TriangulationSettings.model_validate(work.recipe.settings)
        sources: dict[str, Any] = work.recipe.sources
        stride = settings.stride(sources["match_frames"])
        write_joints(store, work, settings, result, TRIANGULATION, stride)
    return work.key


def load_triangulation_settings(store: Store, user: Recipe, clip: str) -> TriangulationSettings:
    """Return the settings of a clip's first triangulation, an input of the recipe `user`."""
    key = user.inputs[f"triangulation/{clip}"]
    recipe = store.manifest(user.match_id, "triangulation", clip, key).recipe
    return TriangulationSettings.model_validate(recipe.settings)


def write_joints(
    store: Store,
    work: Work,
    settings: TriangulationSettings,
    result: ResultWriter,
    layout: GroupLayout,
    stride: int = 1,
) -> None:
    """Triangulate every `stride`-th frame of `work`'s clip in chunks, and write the joints."""
    tracks = select_triangulated(open_input(store, work, f"tracking/{work.recipe.unit}"))
    index = tracks["detection_index"].values
    clip = open_clip(store, work).assign_people(index)
    detections, covariance = clip.detections, camera_errors(work, clip)
    model = learn_clip(clip.cameras, detections, clip.fps, settings, covariance)
    agreements, changes = [], []
    with open_spool(store) as spool:
        chunks = reconstruct_chunks(
            clip.cameras, detections, model, clip.fps, settings, covariance, stride=stride
        )
        for part in chunks:
            spool.add(part_arrays(part.triangulation, part.smoothing))
            agreements.append(part.triangulation.agreement)
            changes.append(part.smoothing.changes)
        result.write(
            layout,
            arrays=spool.arrays()
            | clock_arrays(model.clocks)
            | bias_arrays(model.detector, clip.detections.points, settings),
            coordinates={"frame": detections.frame[::stride], "person": tracks["person"].values},
            attributes={"camera": list(clip.camera_ids), **clip.detections.labels()},
        )
    agreement = reduce(add, agreements).report(model.detector.noise[-1].factor)
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
            f"{work.recipe.name} placed no joint of {index.shape[2]} people: {reason}."
        )
    for report in (
        agreement,
        reduce(add, changes).report(model.motion.acceleration, model.motion.repeated),
        model.clocks.report,
    ):
        result.figures.update(figures_of(report, clip.camera_ids))


def camera_errors(work: Work, clip: ClipInputs) -> NDArray[np.float64] | None:
    """Return each camera's covariance, (cameras, 12, 12); None from the second iteration on.

    Adjusted cameras have accurate relative poses, and a larger position error that all share.
    Treated as independent errors of the cameras, their covariances would displace people.
    Systematic errors of each camera are then estimated from the residuals between cameras.
    """
    is_again = f"filtering/{work.recipe.unit}" in work.recipe.inputs
    return None if is_again else clip.camera_covariance


def part_arrays(joints: Triangulation, smooth: Smoothing) -> dict[str, NDArray[Any]]:
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


def bias_arrays(
    detector: DetectorModel, points: tuple[str, ...], settings: TriangulationSettings
) -> dict[str, NDArray[Any]]:
    """Return the stored errors that all views share."""
    arrays: dict[str, NDArray[Any]] = {"common_bias": detector.common_bias}
    if points:
        arrays["extra_common_bias"] = np.full(len(points), settings.common_bias_m)
    return arrays


def clock_arrays(clocks: CameraClocks) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of the cameras' clock offsets."""
    return {"clock_late": clocks.late, "clock_error": clocks.standard_error}
