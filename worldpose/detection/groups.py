"""People who stand close together, to be looked at again from nearer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from worldpose.detection.boxes import overlaps, suppress
from worldpose.detection.interfaces import People, Picture

Floats = NDArray[np.float64]

TALL: Final = (100.0, 160.0)
"""People of a group are shown about so tall [px], once each: what the detector learns goes to 160;
where one look takes two heads for one, the other may not."""
ZOOMS: Final = (1.25, 3.0)
"""A group that needs less enlarging is seen well enough; none is enlarged more [1]."""
SURE: Final = 0.25
"""Boxes from this score on make a group [1]."""
SAME: Final = 0.6
"""Boxes that share more are one person's [1, intersection over union]."""
NEAR: Final = 0.15
"""Neighbours in a group share more [1, intersection over union]."""
MARGIN: Final = 0.25
"""Who stands so far beside a group belongs to it, as a share of its people's height [1]."""
HEIGHTS: Final = (0.5, 2.0)
"""Shortest and tallest box in a group, as a share of its people's height [1]."""


@dataclass(frozen=True)
class Group:
    """A part of a picture in which people hide one another.

    Attributes:
        corner: left, upper pixel of the part that is looked at.
        end: right, lower pixel, not included.
        zoom: enlargement [1].
        inner: x0, y0, x1, y1 where the middles of its people are [px].
        tall: height of its people [px].
    """

    corner: tuple[int, int]
    end: tuple[int, int]
    zoom: float
    inner: Floats
    tall: float

    def shown(self, picture: Picture) -> Picture:
        """The part of the picture, enlarged."""
        (left, top), (right, bottom) = self.corner, self.end
        part = picture[top:bottom, left:right]
        size = (round(self.zoom * (right - left)), round(self.zoom * (bottom - top)))
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def in_picture(self, people: People) -> People:
        """The group's people among those found in `shown`, in the picture's pixels."""
        sides = np.array(self.end) - self.corner
        scale = np.tile(sides / np.round(self.zoom * sides), 2)
        boxes = (people.boxes + 0.5) * scale - 0.5 + np.tile(self.corner, 2)
        middles = 0.5 * (boxes[:, :2] + boxes[:, 2:])
        shares = (boxes[:, 3] - boxes[:, 1]) / self.tall
        mine = np.all((middles > self.inner[:2]) & (middles < self.inner[2:]), axis=1)
        mine &= (shares > HEIGHTS[0]) & (shares < HEIGHTS[1])
        return People(boxes[mine], people.scores[mine])


def groups(people: People, shape: tuple[int, ...]) -> list[Group]:
    """Return the groups that are worth a look from nearer, each once for every enlargement.

    Args:
        people: as found in the whole picture.
        shape: height, width of the picture [px].
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
        # No look costs more than the first.
        widest = float(np.sqrt(np.prod(size) / np.prod(end - corner)))
        zooms = {min(height / tall, ZOOMS[1], widest) for height in TALL if len(own) > 1}
        found += [
            Group((corner[0], corner[1]), (end[0], end[1]), zoom, inner, tall)
            for zoom in sorted(zooms)
            if zoom >= ZOOMS[0]
        ]
    return found
