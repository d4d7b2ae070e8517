"""Selection of frames for bundle adjustment (B1): many views, spread over pitch and time."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.clip import Clip

_CELL: Final = 8.0
"""Side of a pitch cell [m]: a quarter of the width that a static camera sees."""
_WORTH: Final = 17.0
"""Keypoints of one cell in one camera after which further ones count half [1]: one person."""


def propose_frames(
    clip: Clip,
    count: int,
    gap: float,
    min_views: int,
    taken: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Return indices of the most informative frames for all cameras, ascending.

    Each frame adds keypoints of joints with enough views to cells of the pitch, per camera; further
    keypoints of a cell have diminishing value (the sum of logarithms). A greedy search takes the
    frame that adds most, `gap` away from those before.

    Args:
        clip: cameras, joints and their detections.
        count: maximum number of frames.
        gap: minimum time between two of them [s].
        min_views: minimum inlier cameras of a joint.
        taken: (k,) indices to exclude.

    Note:
        B1.
    """
    offered = _offered(clip, min_views)
    left: NDArray[np.bool_] = np.asarray(offered.any(axis=1))
    left[[] if taken is None else taken] = False
    collected = np.zeros(offered.shape[1])
    chosen: list[int] = []
    while len(chosen) < count and left.any():
        rest = np.flatnonzero(left)
        gain = np.log1p(offered[rest] / (_WORTH + collected)).sum(axis=1)
        best = int(rest[np.argmax(gain)])
        chosen.append(best)
        collected += offered[best]
        near = np.abs(np.arange(len(left)) - best) < gap * clip.fps - 1e-9
        left[near] = False
        left[best] = False
    return np.array(sorted(chosen), dtype=np.int64)


def _offered(clip: Clip, min_views: int) -> NDArray[np.float64]:
    """Return keypoint counts (frames, cells) of every camera's cells; only cells with people."""
    good = np.isfinite(clip.joints[..., 0]) & (clip.views >= min_views)
    number = good.sum(axis=-1)
    place = np.where(good[..., None], clip.joints, 0.0)[..., :2].sum(axis=-2)
    place /= np.maximum(number, 1)[..., None]
    cell = np.floor(place / _CELL).astype(np.int64)
    _, cell_of = np.unique(cell.reshape(-1, 2), axis=0, return_inverse=True)
    cell_of = cell_of.reshape(number.shape)
    frames, cameras, _ = clip.detection_index.shape
    offered = np.zeros((frames, cameras, int(cell_of.max(initial=0)) + 1))
    f, c, p = np.nonzero(clip.detection_index >= 0)
    np.add.at(offered, (f, c, cell_of[f, p]), number[f, p])
    return offered.reshape(frames, -1)
