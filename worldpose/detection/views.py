"""Frames cut into overlapping views, for detectors of one input size or that miss small people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import Detector, People, PoseEstimator
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import suppress


@dataclass(frozen=True)
class ImageTile:
    """A part of a frame as input of a detector.

    Attributes:
        x: left edge in the scaled frame [px].
        y: upper edge [px].
        scale: pixels of the view per pixel of the frame.
    """

    x: int
    y: int
    scale: float

    def to_frame(self, boxes: Floats) -> Floats:
        """Return boxes of the view in frame pixels: pixel centres are whole numbers in both."""
        corner = np.array([self.x, self.y, self.x, self.y], dtype=np.float64)
        return (boxes + corner + 0.5) / self.scale - 0.5


class TiledDetector:
    """A detector that splits frames of any size into views."""

    view_size = None

    def __init__(
        self, detector: Detector, zooms: Sequence[float], view_overlap: float, overlap: float
    ) -> None:
        """Wrap a detector with a view size.

        Frames are scaled by each of the zooms and cut, in addition to one view of the whole frame.
        Neighbours share `view_overlap` of a view; boxes with an intersection over union above
        `overlap` [1] are of one person.
        """
        assert detector.view_size is not None  # others take frames whole
        self._detector, self._size = detector, detector.view_size
        self._zooms, self._view_overlap, self._overlap = tuple(zooms), view_overlap, overlap

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each frame, from views that do not cut them."""
        people = []
        for image in images:
            views = list(self._views(image.shape[1], image.shape[0]))
            found = self._detector.detect(_cut(image, views, self._size))
            seen = [
                self._uncut_people(view, one, image.shape[1], image.shape[0])
                for view, one in zip(views, found, strict=True)
            ]
            people.append(suppress(People.concatenate(seen), self._overlap))
        return people

    def _views(self, width: int, height: int) -> Iterator[ImageTile]:
        fit = min(self._size[0] / width, self._size[1] / height)
        yield ImageTile(0, 0, fit)
        for zoom in self._zooms:
            if zoom > fit:
                across = _starts(round(width * zoom), self._size[0], self._view_overlap)
                down = _starts(round(height * zoom), self._size[1], self._view_overlap)
                yield from (ImageTile(x, y, zoom) for y in down for x in across)

    def _uncut_people(self, view: ImageTile, people: People, width: int, height: int) -> People:
        """Return the people that no inner edge of the view cuts, in frame pixels."""
        x0, y0, x1, y1 = people.boxes.T
        right, low = round(width * view.scale), round(height * view.scale)
        edge = 3.0  # A view's edge cuts a person whose box ends this near to it [px of the view].
        cut = (
            ((x0 < edge) & (view.x > 0))
            | ((y0 < edge) & (view.y > 0))
            | ((x1 > self._size[0] - edge) & (view.x + self._size[0] < right))
            | ((y1 > self._size[1] - edge) & (view.y + self._size[1] < low))
        )
        return People(view.to_frame(people.boxes[~cut]), people.scores[~cut])


def as_frame_detector(detector: Detector, settings: DetectionSettings) -> Detector:
    """Return a detector of whole frames; one with a view size gets views of them."""
    if detector.view_size is None:
        return detector
    return TiledDetector(detector, settings.zooms, settings.view_overlap, settings.nms_iou)


def _starts(length: int, view: int, overlap: float) -> list[int]:
    """Return the evenly spaced starts of views that cover a length."""
    if length <= view:
        return [0]
    count = 1 + int(np.ceil((length - view) / (view * (1.0 - overlap))))
    return [round(start) for start in np.linspace(0, length - view, count)]


def _cut(image: Image, views: Sequence[ImageTile], size: tuple[int, int]) -> list[Image]:
    """Return each view of one frame, filled with grey beyond the frame's border."""
    import cv2  # late: it takes 0.2 s, and planning a run does not need it

    scaled: dict[float, Image] = {}
    cut = []
    for view in views:
        if view.scale not in scaled:
            target = (round(image.shape[1] * view.scale), round(image.shape[0] * view.scale))
            way = cv2.INTER_AREA if view.scale < 1.0 else cv2.INTER_LINEAR
            resized = image if view.scale == 1.0 else cv2.resize(image, target, None, 0, 0, way)
            scaled[view.scale] = np.asarray(resized, dtype=np.uint8)
        part = scaled[view.scale][view.y : view.y + size[1], view.x : view.x + size[0]]
        # Grey level beyond a frame's border, as in the training of detectors.
        filled = np.full((size[1], size[0], 3), 114, dtype=np.uint8)
        filled[: part.shape[0], : part.shape[1]] = part
        cut.append(filled)
    return cut


class FlipTest:
    """An estimator whose poses are the mean over an image and its mirror image.

    Means are weighted by confidence; a keypoint that only one of the two shows comes from that one.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        self._estimator = estimator

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box."""
        last = image.shape[1] - 1
        seen = self._estimator.estimate(image, boxes)
        mirror = self._estimator.estimate(
            np.ascontiguousarray(image[:, ::-1]), _mirror_boxes(boxes, last)
        )
        back = mirror.keypoints[:, COCO17_FLIP] * [-1.0, 1.0] + [last, 0.0]
        both = np.stack([seen.keypoints, back])
        weights = np.nan_to_num(np.stack([seen.confidence, mirror.confidence[:, COCO17_FLIP]]))
        total = weights.sum(axis=0)
        found = total > 0.0
        mean = np.nansum(both * weights[..., None], axis=0) / np.where(found, total, 1.0)[..., None]
        confidence = total / np.maximum((weights > 0.0).sum(axis=0), 1)
        keypoints = np.where(found[..., None], mean, np.nan)
        confidence = np.where(found, confidence, np.nan)
        middle = 0.5 * (seen.boxes + _mirror_boxes(mirror.boxes, last))
        return KeypointDetections(keypoints, confidence, middle, 0.5 * (seen.score + mirror.score))


def _mirror_boxes(boxes: NDArray[np.floating], last: int) -> Floats:
    """Return boxes (people, 4) in the mirror image of a frame whose last column is `last` [px]."""
    return np.asarray(boxes[:, [2, 1, 0, 3]] * [-1.0, 1.0, -1.0, 1.0] + [last, 0.0, last, 0.0])
