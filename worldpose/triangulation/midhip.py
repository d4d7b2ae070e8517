"""Image shift of each person that makes the rays of the mid-hip meet (T4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.geometry import projection
from worldpose.triangulation.noise_model import NoiseModel
from worldpose.triangulation.observations import Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solving import no_shift, solve

HIPS = [COCO17.index("left_hip"), COCO17.index("right_hip")]


def midhip_shift(
    rig: Rig,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    index: NDArray[np.integer],
    settings: TriangulationSettings,
) -> Floats:
    """Return the mid-hip residual of each person in each image, and a zero.

    With the shift subtracted, reprojection residuals are those of the paper's second stage,
    relative to the mid-hip. The shift is 0 in an image without both hips, and for a person without
    a mid-hip.

    Args:
        rig: the cameras.
        keypoints: (frames, cameras, detections, 17, 2) [px].
        confidence: (frames, cameras, detections, 17).
        index: (frames, cameras, persons).
        settings: of triangulation.

    Returns:
        (frames, cameras, persons, 3) [px].
    """
    middle = keypoints[..., HIPS, :].mean(axis=-2, keepdims=True, dtype=np.float64)
    sure = confidence[..., HIPS].min(axis=-1, keepdims=True)
    precision = NoiseModel.stated(1).precision(sure)
    joints = solve(rig, middle, precision, index, no_shift(), settings).joints[:, :, 0]
    image = np.empty((len(rig.cameras), joints[..., 0].size, 2))
    points = np.ascontiguousarray(np.broadcast_to(joints.reshape(1, -1, 3), (*image.shape[:2], 3)))
    projection.project(rig.cameras, points, image)
    image = image.reshape(-1, *joints.shape[:2], 2).swapaxes(0, 1)
    place = np.maximum(index, 0).astype(np.int64)[..., None]
    observed = np.take_along_axis(middle[..., 0, :], place, axis=2)
    there = (index >= 0) & (np.take_along_axis(precision[..., 0], place[..., 0], axis=2) > 0.0)
    shift = np.where(there[..., None], observed - image, 0.0)
    shift = np.where(np.isfinite(shift), shift, 0.0)
    return np.concatenate([shift, np.zeros((*index.shape, 1))], axis=-1)
