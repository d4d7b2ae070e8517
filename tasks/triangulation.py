"""Task of stage `triangulation`: where every joint of one clip is."""

from __future__ import annotations

from data_contracts.run import Work
from data_contracts.triangulation import TRIANGULATION
from tasks.clip_inputs import open_clip
from tasks.unit import figures_of, open_input, unit_task
from worldpose.store import Store
from worldpose.triangulation import TriangulationSettings, triangulate_joints


@unit_task
def triangulation(work: Work) -> str:
    """Publishes joints with covariance; returns the key."""
    store = Store.open(work.project)
    with store.publishing(work) as result:
        clip = open_clip(store, work)
        tracks = open_input(store, work, f"tracking/{work.recipe.unit}")
        joints = triangulate_joints(
            clip.cameras,
            clip.keypoints,
            clip.confidence,
            tracks["detection_index"].values,
            TriangulationSettings.model_validate(work.recipe.settings),
        )
        result.write(
            TRIANGULATION,
            arrays={
                "joints": joints.joints,
                "covariance": joints.covariance,
                "views": joints.views,
                "reprojection_error": joints.reprojection_error,
                "inliers": joints.inliers,
            },
            coordinates={"frame": clip.frame, "person": tracks["person"].values},
            attributes={"camera": list(clip.camera_ids)},
        )
        result.figures.update(figures_of(joints.report, clip.camera_ids))
    return work.key
