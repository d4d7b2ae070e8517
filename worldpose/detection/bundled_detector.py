"""The person detector that ships with the project, small and fast on a CPU.

Its training data are rendered matches alone (infra/embedded_detector). On real footage it is a
fallback; fine-tuned or larger models serve better. Needs torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import torch
from scipy.sparse.csgraph import connected_components

from data_contracts.arrays import Floats, Image
from worldpose.detection.bundled_nets import (
    COARSEST,
    PeopleNet,
    decode_boxes,
    normalize,
    place_net,
    precision,
)
from worldpose.detection.interfaces import MIN_SCORE, People
from worldpose.detection.suppression import suppress
from worldpose.geometry.boxes import box_iou

MAX_PEOPLE: Final = 300
"""Most people per frame."""
NMS_IOU: Final = 0.7
"""Boxes with a larger intersection over union are of one person [1]."""
PEOPLE_HEIGHTS: Final = (100.0, 160.0)
"""The enlarged heights of a group's people [px], one pass per height: the detector is trained on
heights up to 160; where one pass merges two heads, the other may separate them."""
ZOOMS: Final = (1.25, 3.0)
"""A group that needs less enlargement is large enough; none is enlarged more [1]."""
MIN_GROUP_SCORE: Final = 0.25
"""Boxes from this score on form a group [1]."""
SAME_PERSON_IOU: Final = 0.6
"""Boxes that overlap more are one person's [1, intersection over union]."""
MIN_NEIGHBOUR_IOU: Final = 0.15
"""Neighbours in a group overlap more [1, intersection over union]."""
GROUP_MARGIN: Final = 0.25
"""Margin within which people still belong to a group, as a share of its people's height [1]."""
HEIGHT_RANGE: Final = (0.5, 2.0)
"""Shortest and tallest box in a group, as a share of its people's height [1]."""


class BundledDetector:
    """A net that detects the centres of people and the sides of their boxes.

    The detector runs a second time on enlarged crops of groups of people who occlude one another.
    """

    def __init__(self, net: PeopleNet, device: str = "cpu", half: bool = False) -> None:
        self._net, self._device, self._half = place_net(net, device), device, half

    @property
    def view_size(self) -> None:
        """None: the detector takes whole frames of any size."""
        return

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each frame, computed one by one."""
        return [self._people(image) for image in images]

    def _people(self, image: Image) -> People:
        whole = self._detect(image)
        passes = [
            whole,
            *(
                group.to_frame(self._detect(group.crop(image)))
                for group in find_groups(whole, image.shape)
            ),
        ]
        boxes = np.concatenate([people.boxes for people in passes])
        scores = np.concatenate([people.scores for people in passes])
        return suppress(People(boxes, scores), NMS_IOU)

    def _detect(self, image: Image) -> People:
        """Return the detections in an image; the same person may be there twice."""
        height, width = image.shape[:2]
        tall, wide = (-(-side // COARSEST) * COARSEST for side in (height, width))
        padded = np.full((1, tall, wide, 3), 115, dtype=np.uint8)
        padded[0, :height, :width] = image
        with torch.inference_mode(), precision(self._device, self._half):
            given = normalize(torch.from_numpy(padded).to(self._device))
            logits, sides = self._net(given)
            boxes, scores = decode_boxes(logits[0], sides[0], MIN_SCORE, MAX_PEOPLE)
        found = boxes.double().cpu().numpy()
        found = np.clip(found, -0.5, np.array([width, height, width, height]) - 0.5)
        real = np.all(found[:, 2:] - found[:, :2] > 1.0, axis=1)
        return People(found[real], scores.double().cpu().numpy()[real])


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

    def crop(self, image: Image) -> Image:
        """Return the enlarged crop of the frame."""
        (left, top), (right, bottom) = self.corner, self.end
        part = image[top:bottom, left:right]
        size = (round(self.zoom * (right - left)), round(self.zoom * (bottom - top)))
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def to_frame(self, people: People) -> People:
        """Return the group's people among those found in `crop`, in the frame's pixels."""
        sides = np.array(self.end) - self.corner
        scale = np.tile(sides / np.round(self.zoom * sides), 2)
        boxes = (people.boxes + 0.5) * scale - 0.5 + np.tile(self.corner, 2)
        middles = 0.5 * (boxes[:, :2] + boxes[:, 2:])
        shares = (boxes[:, 3] - boxes[:, 1]) / self.tall
        mine = np.all((middles > self.inner[:2]) & (middles < self.inner[2:]), axis=1)
        mine &= (shares > HEIGHT_RANGE[0]) & (shares < HEIGHT_RANGE[1])
        return People(boxes[mine], people.scores[mine])


def find_groups(people: People, shape: tuple[int, ...]) -> list[Group]:
    """Return the groups that need a second detection pass, one entry per enlargement.

    Args:
        people: detections in the whole frame.
        shape: height, width of the frame [px].
    """
    sure = suppress(people, SAME_PERSON_IOU)
    boxes = sure.boxes[sure.scores >= MIN_GROUP_SCORE]
    count, member = connected_components(box_iou(boxes, boxes) > MIN_NEIGHBOUR_IOU, directed=False)
    size = np.array([shape[1], shape[0]])
    found = []
    for number in range(count):
        own = boxes[member == number]
        tall = float(np.median(own[:, 3] - own[:, 1]))
        low, high = own[:, :2].min(axis=0), own[:, 2:].max(axis=0)
        inner = np.concatenate([low - GROUP_MARGIN * tall, high + GROUP_MARGIN * tall])
        corner = np.maximum(np.floor(low - 2.0 * GROUP_MARGIN * tall), 0).astype(int)
        end = np.minimum(np.ceil(high + 2.0 * GROUP_MARGIN * tall), size).astype(int)
        # No second pass costs more than the first.
        widest = float(np.sqrt(np.prod(size) / np.prod(end - corner)))
        zooms = {min(height / tall, ZOOMS[1], widest) for height in PEOPLE_HEIGHTS if len(own) > 1}
        found += [
            Group((corner[0], corner[1]), (end[0], end[1]), zoom, inner, tall)
            for zoom in sorted(zooms)
            if zoom >= ZOOMS[0]
        ]
    return found
