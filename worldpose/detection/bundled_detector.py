"""The person detector that ships with the project, small and fast on a CPU.

Its training data are rendered matches and real frames of one stadium (infra/embedded_detector). On
other real footage fine-tuned or larger models may serve better. Needs torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch

from data_contracts.arrays import Image
from worldpose.detection.bundled_nets import (
    COARSEST,
    PeopleNet,
    decode_boxes,
)
from worldpose.detection.enlargement import (
    STEPS,
    Part,
    choose_reduction,
    find_groups,
    find_small,
    resize,
    restore_size,
)
from worldpose.detection.interfaces import MIN_SCORE, People
from worldpose.detection.net_inference import QuantizedNet, placed_net
from worldpose.detection.suppression import suppress

NMS_IOU: Final = 0.7
"""Boxes with a larger intersection over union are of one person [1]."""


class BundledDetector:
    """A net that detects the centres of people and the sides of their boxes.

    Without a camera, a pass over the reduced frame tells the size of its people: a frame of large
    people is seen reduced. A frame without sure people may be a close-up: it is seen at the size at
    which its surest person is surest.
    """

    def __init__(
        self, net: PeopleNet | QuantizedNet, device: str = "cpu", half: bool = False
    ) -> None:
        self._net = placed_net(net, device, half)

    @property
    def view_size(self) -> None:
        """None: the detector takes whole frames of any size."""
        return

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each frame, computed one by one."""
        return [self._people(image, None) for image in images]

    def detect_parts(self, images: Sequence[Image], parts: Sequence[Part]) -> list[People]:
        """Return the people in each frame; the caller knows where their size is unusual."""
        return [self._people(image, parts) for image in images]

    def _people(self, image: Image, parts: Sequence[Part] | None) -> People:
        if parts is None:
            size = (image.shape[1], image.shape[0])
            # Half size shows people of full height in the training and of twice that height.
            sized = self._detect(resize(image, 0.5))
            zoom = choose_reduction(restore_size(sized, size, 0.5))
            close = self._close_up(image, float(sized.scores.max(initial=0.0)))
            if close < 1.0:
                people = suppress(self._detect(resize(image, close)), NMS_IOU)
                return restore_size(people, size, close)
            if zoom < 1.0:
                return restore_size(self._find_all(resize(image, zoom), None), size, zoom)
        return self._find_all(image, parts)

    def _close_up(self, image: Image, usual: float) -> float:
        """Return the reduction of a frame that people fill; 1 for other frames [1].

        People who fill a frame are as high at these reductions as in the training.
        """
        if usual >= 0.6:  # the best score of people of usual size
            return 1.0
        best, chosen = usual + 0.05, 1.0
        for zoom in (0.25, 0.125, 0.0884, 0.0625):
            score = float(self._detect(resize(image, zoom)).scores.max(initial=0.0))
            if score > best:
                best, chosen = score, zoom
        return chosen

    def _find_all(self, image: Image, parts: Sequence[Part] | None) -> People:
        """Return the people in an image, with passes over its parts."""
        found = self._detect(image)
        if parts is None:
            for step in STEPS:
                found = self._look_at(image, found, find_small(found, image.shape, step))
        else:
            found = self._look_at(image, found, parts)
        found = self._look_at(image, found, find_groups(found, image.shape))
        return suppress(found, NMS_IOU)

    def _look_at(self, image: Image, found: People, parts: Sequence[Part]) -> People:
        """Return the people of earlier passes and of parts of the frame."""
        for part in parts:
            found = part.merge(found, self._detect(part.crop(image)))
        return found

    def _detect(self, image: Image) -> People:
        """Return the detections in an image; the same person may be there twice."""
        height, width = image.shape[:2]
        tall, wide = (-(-side // COARSEST) * COARSEST for side in (height, width))
        padded = np.full((1, tall, wide, 3), 115, dtype=np.uint8)
        padded[0, :height, :width] = image
        with torch.inference_mode():
            logits, sides = self._net(padded)
            boxes, scores = decode_boxes(logits[0], sides[0], MIN_SCORE, 300)  # most people
        found = boxes.double().numpy()
        found = np.clip(found, -0.5, np.array([width, height, width, height]) - 0.5)
        real = np.all(found[:, 2:] - found[:, :2] > 1.0, axis=1)
        return People(found[real], scores.double().numpy()[real])
