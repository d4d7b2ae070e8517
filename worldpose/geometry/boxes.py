"""Axis-aligned boxes in an image: areas and intersection over union."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats


def box_areas(boxes: AnyFloats) -> Floats:
    """Return the areas (...) [px^2] of boxes (..., 4) x0, y0, x1, y1 [px], 0 for reversed sides."""
    x0, y0, x1, y1 = (boxes[..., side] for side in range(4))
    return np.asarray(np.maximum(x1 - x0, 0.0) * np.maximum(y1 - y0, 0.0))


def box_iou(a: AnyFloats, b: AnyFloats) -> Floats:
    """Return the intersection over union (..., n, m) [1] of boxes (..., n, 4) and (..., m, 4) [px].

    It is 0 for disjoint boxes, for boxes without area and for boxes with NaN.
    """
    # Each side by itself: operations along an axis of four numbers take several times as long.
    x0, y0, x1, y1 = (a[..., :, None, side] for side in range(4))
    u0, v0, u1, v1 = (b[..., None, :, side] for side in range(4))
    width, height = np.minimum(x1, u1) - np.maximum(x0, u0), np.minimum(y1, v1) - np.maximum(y0, v0)
    shared = np.maximum(width, 0.0) * np.maximum(height, 0.0)
    union = box_areas(a)[..., :, None] + box_areas(b)[..., None, :] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0))


def are_at_border(boxes: AnyFloats, image_size: NDArray[np.int64]) -> Flags:
    """Return which sides of boxes (..., 4) [px] are at the image's border, which may cut them."""
    # A side so near to the border, relative to the box's height, is cut by it [1].
    margin = np.maximum(2.0, 0.03 * (boxes[..., 3] - boxes[..., 1]))[..., None]
    low, high = boxes[..., :2] < margin, boxes[..., 2:] > image_size - 1.0 - margin
    return np.concatenate([low, high], axis=-1)
