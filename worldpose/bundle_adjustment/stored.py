"""Arrays and attributes of an adjustment, as in `data_contracts.bundle_adjustment`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.adjusting import BundleAdjustment
from worldpose.bundle_adjustment.clip import Clip
from worldpose.bundle_adjustment.directions import weak_direction
from worldpose.bundle_adjustment.outliers import keypoint_outliers, review_clicks
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.geometry import Camera
from worldpose.geometry.stored import camera_arrays


def adjustment_arrays(
    adjusted: BundleAdjustment,
    settings: BundleAdjustmentSettings,
    person: NDArray[np.integer[Any]],
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the stored arrays and attributes of adjusted cameras, without the people.

    Args:
        adjusted: the adjustment.
        settings: of the adjustment.
        person: (persons,) ids.

    Returns:
        Arrays by name, and attributes by name, except the camera ids.
    """
    clip = adjusted.clip
    outliers = keypoint_outliers(
        clip, adjusted.cameras, adjusted.noise, settings.wrong_keypoint, settings.review
    )
    clicks = review_clicks(clip.clicks, adjusted.cameras, adjusted.covariance, settings.click_noise)
    weak = [
        weak_direction(adjusted.cameras[c], adjusted.covariance[c]) for c in range(len(clip.clicks))
    ]
    errors = [marking_errors(clip, cameras) for cameras in (clip.cameras, adjusted.cameras)]
    arrays = {
        **camera_arrays(adjusted.cameras),
        "camera_covariance": adjusted.covariance,
        "accepted": adjusted.accepted,
        "moved_center": adjusted.motion[:, 0],
        "moved_rotation": adjusted.motion[:, 1],
        "moved_focal": adjusted.motion[:, 2],
        "judges": adjusted.verdict.judges,
        "held_out_loss": adjusted.verdict.loss,
        "held_out_error": adjusted.verdict.error,
        "marking_error": np.stack(errors, axis=1),
        "weak_step": np.stack([direction.step for direction in weak]),
        "outlier_frame": clip.frame[outliers.frame],
        "outlier_camera": outliers.camera,
        "outlier_person": person[outliers.person].astype(np.int64),
        "outlier_joint": outliers.joint,
        "outlier_surprise": outliers.surprise,
        "click_camera": clicks.camera,
        "click_residual": clicks.residual,
        "click_surprise": np.where(np.isfinite(clicks.surprise), clicks.surprise, np.nan),
        "click_wrong": clicks.surprise > settings.wrong_click,
    }
    attributes = {
        "reasons": list(adjusted.reasons),
        "held_out_gain": adjusted.evidence.gain,
        "held_out_significance": adjusted.evidence.significance,
        "people_shift": adjusted.evidence.shift,
        "weak": [direction.about for direction in weak],
        "proposed_frames": adjusted.proposed.tolist(),
        "used_frames": adjusted.used.tolist(),
        "judged_frames": adjusted.judged.tolist(),
        "noise_scale": adjusted.noise.scale,
        "noise_correlation": adjusted.noise.correlation,
        "outliers_found": outliers.found,
        "click": list(clicks.name),
        "click_problem": list(clicks.problem),
    }
    return arrays, attributes


def marking_errors(clip: Clip, cameras: Camera) -> NDArray[np.float64]:
    """Return the root mean square error per axis (cameras,) [px] of clicks used in calibration.

    Args:
        clip: its clicks.
        cameras: (cameras,) batch.

    Returns:
        NaN for cameras without such clicks.
    """
    errors = np.full(len(clip.clicks), np.nan)
    for c, clicks in enumerate(clip.clicks):
        if clicks.inlier.any():
            pixels = cameras[c].project(clicks.points_world[clicks.inlier])
            off = pixels - clicks.points_image[clicks.inlier]
            errors[c] = np.sqrt(np.mean(off**2))
    return errors
