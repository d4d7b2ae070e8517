"""Axis-aligned boxes in an image: areas and intersection over union."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import AnyFloats, Floats


def box_areas(boxes: AnyFloats) -> Floats:
    """Return the areas (...) [px^2] of boxes (..., 4) x0, y0, x1, y1 [px], 0 for reversed sides."""
    return np.asarray(np.maximum(boxes[..., 2:] - boxes[..., :2], 0.0).prod(axis=-1))


def box_iou(a: AnyFloats, b: AnyFloats) -> Floats:
    """Return the intersection over union (..., n, m) [1] of every pair of boxes.

    It is 0 for disjoint boxes, for boxes without area and for boxes with NaN.

    Args:
        a: (..., n, 4) x0, y0, x1, y1 [px].
        b: (..., m, 4) [px].
    """
    first, second = a[..., :, None, :], b[..., None, :, :]
    sides = np.minimum(first[..., 2:], second[..., 2:]) - np.maximum(
        first[..., :2], second[..., :2]
    )
    shared = np.maximum(sides, 0.0).prod(axis=-1)
    union = box_areas(first) + box_areas(second) - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0))
