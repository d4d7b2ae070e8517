"""Groups of people close together, for a second detection pass on enlarged crops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from data_contracts.arrays import Floats, Image
from worldpose.detection.boxes import overlaps, suppress
from worldpose.detection.interfaces import People

TALL: Final = (100.0, 160.0)
"""The enlarged heights of a group's people [px], one pass per height: the detector is trained on
heights up to 160; where one pass merges two heads, the other may separate them."""
ZOOMS: Final = (1.25, 3.0)
"""A group that needs less enlargement is large enough; none is enlarged more [1]."""
SURE: Final = 0.25
"""Boxes from this score on form a group [1]."""
SAME: Final = 0.6
"""Boxes that overlap more are one person's [1, intersection over union]."""
NEAR: Final = 0.15
"""Neighbours in a group overlap more [1, intersection over union]."""
MARGIN: Final = 0.25
"""Margin within which people still belong to a group, as a share of its people's height [1]."""
HEIGHTS: Final = (0.5, 2.0)
"""Shortest and tallest box in a group, as a share of its people's height [1]."""


@dataclass(frozen=True)
class Group:
    """A part of a frame in which people occlude one another.

    Attributes:
        corner: left, upper pixel of the crop.
        end: right, lower pixel, not included.
        zoom: enlargement [1].
        inner: x0, y0, x1, y1 of the region that holds the centres of its people [px].
        tall: median height of its people [px].
    """

    corner: tuple[int, int]
    end: tuple[int, int]
    zoom: float
    inner: Floats
    tall: float

    def shown(self, picture: Image) -> Image:
        """Return the enlarged crop of the frame."""
        (left, top), (right, bottom) = self.corner, self.end
        part = picture[top:bottom, left:right]
        size = (round(self.zoom * (right - left)), round(self.zoom * (bottom - top)))
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def in_picture(self, people: People) -> People:
        """Return the group's people among those found in `shown`, in the frame's pixels."""
        sides = np.array(self.end) - self.corner
        scale = np.tile(sides / np.round(self.zoom * sides), 2)
        boxes = (people.boxes + 0.5) * scale - 0.5 + np.tile(self.corner, 2)
        middles = 0.5 * (boxes[:, :2] + boxes[:, 2:])
        shares = (boxes[:, 3] - boxes[:, 1]) / self.tall
        mine = np.all((middles > self.inner[:2]) & (middles < self.inner[2:]), axis=1)
        mine &= (shares > HEIGHTS[0]) & (shares < HEIGHTS[1])
        return People(boxes[mine], people.scores[mine])


def groups(people: People, shape: tuple[int, ...]) -> list[Group]:
    """Return the groups that need a second detection pass, one entry per enlargement.

    Args:
        people: detections in the whole frame.
        shape: height, width of the frame [px].
    """
    sure = suppress(people, SAME)
    boxes = sure.boxes[sure.scores >= SURE]
    count, member = connected_components(overlaps(boxes, boxes) > NEAR, directed=False)
    size = np.array([shape[1], shape[0]])
    found = []
    for number in range(count):
        own = boxes[member == number]
        tall = float(np.median(own[:, 3] - own[:, 1]))
        low, high = own[:, :2].min(axis=0), own[:, 2:].max(axis=0)
        inner = np.concatenate([low - MARGIN * tall, high + MARGIN * tall])
        corner = np.maximum(np.floor(low - 2.0 * MARGIN * tall), 0).astype(int)
        end = np.minimum(np.ceil(high + 2.0 * MARGIN * tall), size).astype(int)
        # No second pass costs more than the first.
        widest = float(np.sqrt(np.prod(size) / np.prod(end - corner)))
        zooms = {min(height / tall, ZOOMS[1], widest) for height in TALL if len(own) > 1}
        found += [
            Group((corner[0], corner[1]), (end[0], end[1]), zoom, inner, tall)
            for zoom in sorted(zooms)
            if zoom >= ZOOMS[0]
        ]
    return found
