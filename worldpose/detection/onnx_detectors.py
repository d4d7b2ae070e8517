"""Detectors in ONNX files: YOLO-type boxes, and MoveNet MultiPose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worldpose.detection.boxes import suppress
from worldpose.detection.interfaces import LEAST_SCORE, Detector, People, Picture
from worldpose.detection.onnx_session import OnnxNet, unknown_outputs

PERSON: Final = 0
"""Class of people in nets trained on COCO."""
VIEW_SIZE: Final = (640, 640)
"""What a net that takes any size is given [px]."""
DOUBLES: Final = 0.7
"""Boxes of a raw grid that overlap by more are of one person [1]."""
MULTIPOSE: Final = 56
"""Numbers a person of MoveNet MultiPose: 17 y, x and scores, then the box and its score."""

Reader = Callable[[NDArray[Any]], People]


def onnx_detector(file: Path, device: str = "cpu") -> Detector:
    """A detector of people from an ONNX file.

    The form of the output tells what it is: (batch, 4 + classes, anchors) of YOLOv8 and later with
    middle, size and class scores; (batch, anchors, 5 + classes) of YOLOv5 with a score of being
    anything before them; (batch, boxes, 6) of exports that end with suppression, corners, score
    and class; (batch, people, 56) of MoveNet MultiPose. Pictures go in as RGB, as 0..1 for all but
    MoveNet, which takes 0..255.

    Args:
        file: the net.
        device: `cpu` or `cuda`.

    Raises:
        InputError: onnxruntime is not there, or the file is no such net.
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
    """A net that looks at views of its size."""

    def __init__(self, net: OnnxNet, scale: float, read: Reader) -> None:
        self._net, self._scale, self._read = net, scale, read

    @property
    def view_size(self) -> tuple[int, int]:
        """What the net takes."""
        return self._net.size

    def detect(self, pictures: Sequence[Picture]) -> list[People]:
        """The people of each view."""
        if not pictures:
            return []
        given: NDArray[Any] = np.stack(pictures)
        if self._scale != 1.0:
            given = given.astype(np.float32) * np.float32(self._scale)
        return [self._read(found.astype(np.float64)) for found in self._net.run(given)[0]]


def _multipose(found: NDArray[np.float64], size: tuple[int, int]) -> People:
    """Boxes y0, x0, y1, x1 in 0..1 behind the keypoints."""
    width, height = size
    corners = found[:, [52, 51, 54, 53]] * [width, height, width, height] - 0.5
    return _likely(corners, found[:, 55])


def _corners(found: NDArray[np.float64]) -> People:
    """Corners in pixels, score and class."""
    people = found[found[:, 5].round() == PERSON]
    return _likely(people[:, :4] - 0.5, people[:, 4])


def _grid(found: NDArray[np.float64], *, with_object: bool) -> People:
    """Middle and size in pixels, perhaps a score of being anything, then a score a class."""
    middle, size = found[:, :2], found[:, 2:4]
    score = found[:, 5 + PERSON] * found[:, 4] if with_object else found[:, 4 + PERSON]
    corners = np.hstack([middle - size / 2.0, middle + size / 2.0]) - 0.5
    return suppress(_likely(corners, score), DOUBLES)


def _likely(boxes: NDArray[np.float64], scores: NDArray[np.float64]) -> People:
    """Those above the least score; edges of pixels became their centres before."""
    kept = scores >= LEAST_SCORE
    return People(boxes[kept], np.minimum(scores[kept], 1.0))
