"""Add a detector: people are what is neither grass nor paint, in images of one static camera.

    worldpose simulate --scenario tiny --render --seed 1 --duration 1 --out match
    python examples/add_detector.py match/videos/cam00.mp4 out/cam00.npz

A detector is a class with the attribute and the method of `Detector`. The bundled pose net then
finds the keypoints. `worldpose import --detections out` takes the files of all cameras.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

import worldpose as wp
from data_contracts.arrays import Image
from worldpose.detection.interfaces import People
from worldpose.formats.keypoint_files import write_keypoint_arrays

GRASS = ((30, 40, 20), (90, 255, 255))  # hue, saturation and value of OpenCV, lowest and highest
PAINT = ((0, 0, 170), (180, 60, 255))


class OffGrassDetector:
    """Boxes around upright regions of other colours than the pitch."""

    view_size = None  # it takes images of any size

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each RGB image."""
        return [self._detect(image) for image in images]

    def _detect(self, image: Image) -> People:
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        grass, paint = (cv2.inRange(hsv, *map(np.array, each)) for each in (GRASS, PAINT))
        people = 255 - cv2.bitwise_or(grass, paint)
        other = cv2.morphologyEx(people, cv2.MORPH_CLOSE, np.ones((7, 3), np.uint8))
        _, _, found, _ = cv2.connectedComponentsWithStats(other)
        x, y, width, height, area = found[1:].T.astype(np.float64)
        kept = (
            (height > 20) & (height < 200) & (height > 1.2 * width) & (area > 0.2 * width * height)
        )
        boxes = np.stack([x, y, x + width - 1.0, y + height - 1.0], axis=1)[kept]
        return People(boxes, np.full(len(boxes), 0.9))


if __name__ == "__main__":
    video, out = map(Path, sys.argv[1:])
    with wp.open_video(video) as pictures:
        images = (image for _, image in pictures.frames())
        people = wp.detect_people(images, detectors=[OffGrassDetector()])
    out.parent.mkdir(parents=True, exist_ok=True)
    write_keypoint_arrays(out, people)
    print(f"{np.isfinite(people.score).sum() / len(people.frame):.1f} people per image")
