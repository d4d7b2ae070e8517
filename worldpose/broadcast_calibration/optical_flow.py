"""Optical flow of static points between neighbouring frames of a clip (M2, M6)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image

_WINDOW: Final = (21, 21)
_LEVELS: Final = 4
"""Levels of the pyramid: motion up to 150 px per frame."""
_RETURN: Final = 0.3
"""Maximum forward-backward error [px]."""
_CELLS: Final = (16, 9)
"""Columns and rows of cells, each with its share of the points."""
_QUALITY: Final = 0.002
"""Minimum strength of a corner, relative to the strongest in the frame [1]."""
_AWAY: Final = 0.15
"""Margin around a person's box, relative to its height [1]."""
_CONSISTENT: Final = 1.5
"""Maximum inlier distance of a homography [px]."""
_TELLING: Final = 12
"""Minimum points to decide on a cut [1]."""


@dataclass(frozen=True, eq=False)
class Followed:
    """Points followed from one frame to the next.

    Attributes:
        start: (n, 2) [px].
        end: (n, 2) [px].
        together: share of the searched points that are inliers of one homography [1]; NaN with too
            few points.
    """

    start: Floats
    end: Floats
    together: float


def follow(pictures: Iterable[Image], boxes: Floats | None, points: int) -> list[Followed]:
    """Return the points followed between all neighbouring frames.

    The function selects new corners in every frame, evenly over the image, so that errors do not
    accumulate along a track. Pyramidal Lucas-Kanade runs forward and backward; points with a large
    forward-backward error are dropped.

    Args:
        pictures: grey (height, width), in order.
        boxes: (frames, detections, 4) x0 y0 x1 y1 [px] of people, which move; NaN = missing.
        points: approximate number of points.
    """
    followed: list[Followed] = []
    before: Image | None = None
    for number, picture in enumerate(pictures):
        if before is not None:
            people = None if boxes is None else boxes[number - 1]
            followed.append(_follow(before, picture, people, points))
        before = picture
    return followed


def _follow(before: Image, after: Image, people: Floats | None, points: int) -> Followed:
    start = _corners(before, people, points)
    if len(start) < _TELLING:
        return Followed(np.empty((0, 2)), np.empty((0, 2)), float("nan"))
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, start.copy(), winSize=_WINDOW, maxLevel=_LEVELS
    )
    home, back, _ = cv2.calcOpticalFlowPyrLK(
        after, before, end, end.copy(), winSize=_WINDOW, maxLevel=_LEVELS
    )
    size = np.array([before.shape[1], before.shape[0]])
    # Near the border the window extends beyond the image.
    inside = ((end > _WINDOW[0] / 2) & (end < size - 1 - _WINDOW[0] / 2)).all(axis=-1)
    same = np.linalg.norm(home - start, axis=-1) < _RETURN
    kept = (found[:, 0] == 1) & (back[:, 0] == 1) & same & inside
    one, two = start[kept].astype(np.float64), end[kept].astype(np.float64)
    looked = float(inside.sum())
    if len(one) < _TELLING or looked < _TELLING:
        return Followed(one, two, 0.0 if looked >= _TELLING else float("nan"))
    _, agree = cv2.findHomography(one, two, cv2.RANSAC, _CONSISTENT)
    together = 0.0 if agree is None else float(agree.sum()) / looked
    return Followed(one, two, together)


def _corners(picture: Image, people: Floats | None, points: int) -> NDArray[np.float32]:
    """Return corners (n, 2) [px], the strongest of each image cell, outside people's boxes."""
    half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    strength = cv2.cornerMinEigenVal(half, 5)
    margin = _WINDOW[0] // 2
    strength[:margin] = strength[-margin:] = 0.0
    strength[:, :margin] = strength[:, -margin:] = 0.0
    for x0, y0, x1, y1 in np.empty((0, 4)) if people is None else people:
        if np.isfinite(x0 + y0 + x1 + y1):
            away = _AWAY * (y1 - y0) + margin
            left, right = max(0.5 * (x0 - away), 0.0), max(0.5 * (x1 + away), 0.0)
            top, bottom = max(0.5 * (y0 - away), 0.0), max(0.5 * (y1 + away), 0.0)
            strength[int(top) : int(bottom) + 1, int(left) : int(right) + 1] = 0.0
    peaks = strength == cv2.dilate(strength, np.ones((7, 7), np.uint8))
    peaks &= strength > max(_QUALITY * float(strength.max()), 1e-7)
    v, u = np.nonzero(peaks)
    height, width = half.shape
    cell = (u * _CELLS[0] // width) + _CELLS[0] * (v * _CELLS[1] // height)
    order = np.lexsort((-strength[v, u], cell))
    cell = cell[order]
    first = np.searchsorted(cell, cell)
    each = max(1, round(points / (_CELLS[0] * _CELLS[1])))
    chosen = order[np.arange(len(cell)) - first < each]
    # The center of a half-resolution pixel is between two full-resolution pixels.
    return np.stack([2 * u[chosen] + 0.5, 2 * v[chosen] + 0.5], axis=-1).astype(np.float32)
