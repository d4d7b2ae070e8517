"""Bounding boxes of people in an image, and their intersection over union (E3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera
from worldpose.geometry.boxes import box_iou


def joint_boxes(joints: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return boxes around projected joints (frames, persons, 4) x0 y0 x1 y1 [px].

    NaN where no joint is in front of the camera. Boxes are not clipped to the image.

    Args:
        joints: (frames, persons, joints, 3) [m], world; NaN where missing.
        camera: one camera, or one per frame.
    """
    frames, persons, count, _ = joints.shape
    image = camera.project(joints.reshape(frames, persons * count, 3))
    image = image.reshape(frames, persons, count, 2)
    known = np.isfinite(image)
    low = np.where(known, image, np.inf).min(axis=-2, initial=np.inf)
    high = np.where(known, image, -np.inf).max(axis=-2, initial=-np.inf)
    boxes = np.concatenate([low, high], axis=-1)
    return np.where(np.isfinite(boxes), boxes, np.nan)


def box_overlaps(predicted: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return intersection over union of all pairs (frames, true, predicted) [0..1].

    NaN where a box is missing; 0 for boxes without area.

    Args:
        predicted: (frames, predicted persons, 4) x0 y0 x1 y1 [px].
        true: (frames, true persons, 4) [px].
    """
    missing = np.isnan(true[:, :, None]).any(axis=-1) | np.isnan(predicted[:, None]).any(axis=-1)
    return np.where(missing, np.nan, box_iou(true, predicted))
