"""Task of stage `bundle_adjustment`: one clip's cameras adjusted, its people placed again."""

from __future__ import annotations

import numpy as np
import xarray as xr

from data_contracts.bundle_adjustment import BUNDLE_ADJUSTMENT
from data_contracts.pitch import PitchSpec
from data_contracts.run import Work
from tasks.clip_inputs import open_clip
from tasks.triangulation import reconstruction_arrays, reconstruction_figures
from tasks.unit import open_input, unit_task
from worldpose.bundle_adjustment import (
    BundleAdjustment,
    BundleAdjustmentSettings,
    Clicks,
    Clip,
    adjust_cameras,
    adjustment_arrays,
)
from worldpose.cameras import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration import PARAMETERS
from worldpose.store import Store
from worldpose.triangulation import TriangulationSettings, reconstruct_joints


@unit_task
def bundle_adjustment(work: Work) -> str:
    """Publishes cameras and the joints that they give; returns the key."""
    store = Store.open(work.project)
    with store.publishing(work) as result:
        opened = open_clip(store, work)
        tracks = open_input(store, work, f"tracking/{work.recipe.unit}")
        index = tracks["detection_index"].values
        placed = open_input(store, work, f"triangulation/{work.recipe.unit}")
        known = [
            open_input(store, work, f"static_calibration/{camera}") for camera in opened.camera_ids
        ]
        pitch = work.recipe.sources["pitch"]
        template = None if pitch is None else PitchTemplate.from_spec(PitchSpec(**pitch))
        clip = Clip(
            cameras=opened.cameras,
            covariance=np.stack([_covariance(camera) for camera in known]),
            clicks=tuple(
                _clicks(camera, opened.cameras[c], template) for c, camera in enumerate(known)
            ),
            frame=opened.frame,
            fps=opened.fps,
            keypoints=opened.keypoints,
            confidence=opened.confidence,
            detection_index=index.astype(np.int64),
            joints=placed["joints"].values,
            views=placed["views"].values.astype(np.int64),
            triangulation=_triangulation_settings(store, work),
        )
        settings = BundleAdjustmentSettings.model_validate(work.recipe.settings)
        adjusted = adjust_cameras(clip, settings)
        found = reconstruct_joints(
            adjusted.cameras,
            *(opened.keypoints, opened.confidence, index, opened.fps, clip.triangulation),
        )
        arrays, attributes = adjustment_arrays(adjusted, settings, tracks["person"].values)
        result.write(
            BUNDLE_ADJUSTMENT,
            arrays={**reconstruction_arrays(found), **arrays},
            coordinates={"frame": opened.frame, "person": tracks["person"].values},
            attributes={"camera": list(opened.camera_ids), **attributes},
        )
        result.figures.update(reconstruction_figures(found, opened.camera_ids))
        result.figures.update(_figures(adjusted))
    return work.key


def _triangulation_settings(store: Store, work: Work) -> TriangulationSettings:
    """The settings that the joints were placed with: they are placed with them again."""
    name = f"triangulation/{work.recipe.unit}"
    stage, _, unit = name.partition("/")
    manifest = store.manifest(work.recipe.match_id, stage, unit, work.recipe.inputs[name])
    return TriangulationSettings.model_validate(manifest.recipe.settings)


def _covariance(known: xr.Dataset) -> np.ndarray:
    """The covariance of a calibrated camera; zero of a given one."""
    if "covariance" not in known:
        return np.zeros((len(PARAMETERS), len(PARAMETERS)))
    return np.asarray(known["covariance"].values)


def _clicks(known: xr.Dataset, camera: Camera, pitch: PitchTemplate | None) -> Clicks:
    """What was clicked, from where the camera projects it and how far off that is."""
    if pitch is None or "point_residual" not in known:
        return Clicks.none()
    names = tuple(str(name) for name in known["point"].values)
    places = pitch.positions(names)
    pixels = camera.project(places) - known["point_residual"].values
    return Clicks(names, places, pixels, known["point_inlier"].values)


def _figures(adjusted: BundleAdjustment) -> dict[str, float]:
    """Figures of the adjustment."""
    figures = {
        "cameras_changed": float(adjusted.accepted.sum()),
        "cameras_refused": float((~adjusted.accepted).sum()),
        "noise_scale": adjusted.noise.scale,
        "noise_correlation": adjusted.noise.correlation,
    }
    error = adjusted.verdict.error
    if np.isfinite(error).any():
        figures["held_out_error_before_px"] = float(np.nanmedian(error[:, 0]))
        figures["held_out_error_after_px"] = float(np.nanmedian(error[:, 1]))
    return figures
