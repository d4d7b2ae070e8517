"""Task of stage `triangulation`: where every joint of one clip is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from data_contracts.run import Work
from data_contracts.triangulation import TRIANGULATION
from tasks.clip_inputs import open_clip
from tasks.unit import figures_of, open_input, unit_task
from worldpose.store import Store
from worldpose.triangulation import Reconstruction, TriangulationSettings, reconstruct_joints


@unit_task
def triangulation(work: Work) -> str:
    """Publishes joints with covariance; returns the key."""
    store = Store.open(work.project)
    with store.publishing(work) as result:
        clip = open_clip(store, work)
        tracks = open_input(store, work, f"tracking/{work.recipe.unit}")
        found = reconstruct_joints(
            clip.cameras,
            clip.keypoints,
            clip.confidence,
            tracks["detection_index"].values,
            clip.fps,
            TriangulationSettings.model_validate(work.recipe.settings),
            clip.camera_covariance,
        )
        result.write(
            TRIANGULATION,
            arrays=reconstruction_arrays(found),
            coordinates={"frame": clip.frame, "person": tracks["person"].values},
            attributes={"camera": list(clip.camera_ids)},
        )
        result.figures.update(reconstruction_figures(found, clip.camera_ids))
    return work.key


def reconstruction_arrays(found: Reconstruction) -> dict[str, NDArray[Any]]:
    """The stored arrays of a clip's joints, by name."""
    joints, smooth = found.triangulation, found.smoothing
    return {
        "joints": joints.joints,
        "covariance": joints.covariance,
        "views": joints.views,
        "spread": joints.spread,
        "reprojection_error": joints.reprojection_error,
        "inliers": joints.inliers,
        "offsets": joints.offsets.astype("float32"),
        "smoothed": smooth.joints,
        "smoothed_covariance": smooth.covariance,
        "filled": smooth.filled,
        "clock_late": found.clocks.late,
        "clock_error": found.clocks.standard_error,
    }


def reconstruction_figures(found: Reconstruction, camera_ids: Sequence[str]) -> dict[str, float]:
    """The figures of a clip's joints."""
    reports = (found.triangulation.report, found.smoothing.report, found.clocks.report)
    figures: dict[str, float] = {}
    for report in reports:
        figures |= figures_of(report, camera_ids)
    return figures
