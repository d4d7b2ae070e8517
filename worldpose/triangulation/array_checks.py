"""Checks that the arrays of one clip have matching shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.geometry import Camera


def check_arrays(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    detection_index: NDArray[np.int16],
    camera_covariance: NDArray[np.float64] | None,
) -> None:
    """Raise InputError unless the arrays have matching shapes and valid indices."""
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
