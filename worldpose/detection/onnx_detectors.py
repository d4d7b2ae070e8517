"""Detectors in ONNX files: YOLO-type boxes, and MoveNet MultiPose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image
from worldpose.detection.boxes import suppress
from worldpose.detection.interfaces import LEAST_SCORE, Detector, People
from worldpose.detection.onnx_session import OnnxNet, unknown_outputs

PERSON: Final = 0
"""Class of people in nets trained on COCO."""
VIEW_SIZE: Final = (640, 640)
"""Input size for a net that takes any size [px]."""
DOUBLES: Final = 0.7
"""Boxes of a raw grid with a larger intersection over union are of one person [1]."""
MULTIPOSE: Final = 56
"""Numbers per person of MoveNet MultiPose: 17 y, x and scores, then the box and its score."""

Reader = Callable[[NDArray[Any]], People]


def onnx_detector(file: Path, device: str = "cpu") -> Detector:
    """Return a detector of people from an ONNX file.

    The shape of the output decides how it is read: (batch, 4 + classes, anchors) of YOLOv8 and
    later with centre, size and class scores; (batch, anchors, 5 + classes) of YOLOv5 with an
    objectness score before the class scores; (batch, boxes, 6) of exports with built-in
    suppression: corners, score and class; (batch, people, 56) of MoveNet MultiPose. Inputs are
    RGB, as 0..1 for all but MoveNet, which takes 0..255.

    Args:
        file: the net.
        device: `cpu` or `cuda`.

    Raises:
        InputError: onnxruntime is not installed, or the file is no such net.
    """
    net = OnnxNet(file, device, VIEW_SIZE)
    shape = net.outputs[0] if net.outputs else ()
    if len(shape) != 3:
        raise unknown_outputs(net, _FORMS)
    _, rows, columns = shape
    if columns == MULTIPOSE:
        return _OnnxDetector(net, 1.0, lambda found: _multipose(found, net.size))
    if columns == 6:
        return _OnnxDetector(net, 1.0 / 255.0, _corners)
    if rows is not None and (columns is None or rows < columns) and rows > 4:
        return _OnnxDetector(net, 1.0 / 255.0, lambda found: _grid(found.T, with_object=False))
    if columns is not None and columns > 5:
        return _OnnxDetector(net, 1.0 / 255.0, lambda found: _grid(found, with_object=True))
    raise unknown_outputs(net, _FORMS)


_FORMS: Final = (
    "(batch, 4 + classes, anchors), (batch, anchors, 5 + classes), (batch, boxes, 6) or "
    "(batch, people, 56)"
)


class _OnnxDetector:
    """A detector of people in views of the net's size."""

    def __init__(self, net: OnnxNet, scale: float, read: Reader) -> None:
        self._net, self._scale, self._read = net, scale, read

    @property
    def view_size(self) -> tuple[int, int]:
        """Input size of the net."""
        return self._net.size

    def detect(self, pictures: Sequence[Image]) -> list[People]:
        """Return the people in each view."""
        if not pictures:
            return []
        given: NDArray[Any] = np.stack(pictures)
        if self._scale != 1.0:
            given = given.astype(np.float32) * np.float32(self._scale)
        return [self._read(found.astype(np.float64)) for found in self._net.run(given)[0]]


def _multipose(found: NDArray[np.float64], size: tuple[int, int]) -> People:
    """Return people from rows with keypoints first, then boxes y0, x0, y1, x1 in 0..1."""
    width, height = size
    corners = found[:, [52, 51, 54, 53]] * [width, height, width, height] - 0.5
    return _likely(corners, found[:, 55])


def _corners(found: NDArray[np.float64]) -> People:
    """Return people from rows of corners in pixels, score and class."""
    people = found[found[:, 5].round() == PERSON]
    return _likely(people[:, :4] - 0.5, people[:, 4])


def _grid(found: NDArray[np.float64], *, with_object: bool) -> People:
    """Return people from rows of centre, size, perhaps objectness, then a score per class."""
    middle, size = found[:, :2], found[:, 2:4]
    score = found[:, 5 + PERSON] * found[:, 4] if with_object else found[:, 4 + PERSON]
    corners = np.hstack([middle - size / 2.0, middle + size / 2.0]) - 0.5
    return suppress(_likely(corners, score), DOUBLES)


def _likely(boxes: NDArray[np.float64], scores: NDArray[np.float64]) -> People:
    """Return those above the least score; callers converted pixel edges to pixel centres."""
    kept = scores >= LEAST_SCORE
    return People(boxes[kept], np.minimum(scores[kept], 1.0))
