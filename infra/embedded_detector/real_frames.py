"""Real frames for the detector's last phase: labelled stills, and video labelled by two nets.

DATA holds `panorama_people` (stills with YOLO labels; SoccerTrack v2, CC BY 4.0), `static_pair`
(two videos; SportsLabKit, MIT) and `weights/yolox_nano.onnx` (YOLOX, Apache-2.0). The second half
of the panorama's match and the videos from frame 100 on are for tests and never read here.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.conventions import COCO17_FLIP
from worldpose.detection.interfaces import People, PoseEstimator
from worldpose.detection.models import load_bundled_detector
from worldpose.detection.onnx_detectors import load_onnx_detector
from worldpose.detection.onnx_nets import load_onnx_pose
from worldpose.detection.suppression import suppress
from worldpose.detection.views import TiledDetector
from worldpose.geometry.boxes import box_iou
from worldpose.training.labels import LabelledPicture, write_labels

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from yolo_labels import label_boxes, read_yolo_labels

FRAMES: Final = range(2, 100, 12)
"""Frames of each video: half a second apart, people have moved."""
ZOOMS: Final = (1.0, 1.5)
"""Enlargements at which YOLOX sees tiles of 416 px [1]."""
SURE_SCORE: Final = 0.25
"""Both nets give a labelled person this score at least [1]."""
SURE_IOU: Final = 0.6
"""Both nets' boxes of a labelled person overlap by this much at least [1]."""
DOUBT_SCORE: Final = 0.1
"""Detections of YOLOX alone with this score or more are ignored in training [1]; detections of the
bundled net alone are background."""
SAME_IOU: Final = 0.5
"""Boxes that overlap more are one person's [1]."""
WIDER: Final = np.array([0.15, 0.08])
"""Margins of the wider box, as shares of width and height [1]."""
JOINT_SPREAD: Final = 0.04
"""Views of a labelled joint differ by less, as a share of the person's height [1]."""
JOINT_CONFIDENCE: Final = 0.35
"""MoveNet gives a labelled joint more confidence in each view [1]."""
MIN_HEIGHT: Final = 40.0
"""Joints of smaller people are not labelled [px]."""


def read_panorama(data: Path) -> list[LabelledPicture]:
    """Return the labelled stills of the first half."""
    files = sorted((data / "panorama_people").glob("*_1st_*.jpg"))
    return [read_yolo_labels(file) for file in files if file.with_suffix(".txt").stat().st_size]


def label_pair(data: Path, movenet: Path, folder: Path) -> Iterator[str]:
    """Write frames of both videos with the labels that nets agree on; yield a line for each.

    Existing labels are kept.

    Args:
        data: see above.
        movenet: MoveNet Thunder as ONNX (Apache-2.0), see infra/real_demo/fetch.py.
        folder: of the labelled frames.
    """
    pose = load_onnx_pose(movenet)
    yolox = load_onnx_detector(data / "weights" / "yolox_nano.onnx")
    teachers = [TiledDetector(yolox, (zoom,), 0.25, 0.65) for zoom in ZOOMS]
    bundled = load_bundled_detector()
    for side in ("left", "right"):
        labels = folder / side / "labels.json"
        if not labels.exists():
            labels.parent.mkdir(parents=True, exist_ok=True)
            video = data / "static_pair" / f"{side}_camera.mp4"
            pictures, size = [], (0, 0)
            for number, image in read_frames(video):
                path = labels.parent / f"{number:03d}.png"
                cv2.imwrite(str(path), image[..., ::-1])
                given = [teacher.detect([image])[0] for teacher in teachers]
                boxes, doubtful = agree_on_people(given, bundled.detect([image])[0])
                ignored = np.arange(len(boxes) + len(doubtful)) >= len(boxes)
                people = label_boxes(path, np.concatenate([boxes, doubtful]), ignored)
                keypoints, visible = agree_on_joints(pose, image, boxes)
                people.keypoints[~ignored], people.visible[~ignored] = keypoints, visible
                pictures.append(people)
                size = (image.shape[1], image.shape[0])
            write_labels(labels, pictures, size)
        yield f"{folder.name}: {side} video"


def read_frames(video: Path) -> Iterator[tuple[int, Image]]:
    """Yield number and RGB image of the labelled frames."""
    reader = cv2.VideoCapture(str(video))
    for number in range(FRAMES.stop):
        _, image = reader.read()
        if number in FRAMES:
            yield number, np.ascontiguousarray(np.asarray(image, dtype=np.uint8)[..., ::-1])


def agree_on_people(yolox: list[People], bundled: People) -> tuple[Floats, Floats]:
    """Return boxes of people that both nets see (n, 4), and those in doubt (m, 4) [px].

    Args:
        yolox: at several enlargements.
        bundled: in the whole image.
    """
    every = People(
        np.concatenate([each.boxes for each in yolox]),
        np.concatenate([each.scores for each in yolox]),
    )
    seen = suppress(every, SAME_IOU)
    first = seen.boxes[seen.scores >= SURE_SCORE]
    second = bundled.boxes[bundled.scores >= SURE_SCORE]
    possible = seen.boxes[seen.scores >= DOUBT_SCORE]
    if not len(first) or not len(second):
        return np.empty((0, 4)), possible
    overlap = box_iou(first, second)
    best, rows = overlap.argmax(axis=1), np.arange(len(first))
    mutual = (overlap.argmax(axis=0)[best] == rows) & (overlap[rows, best] >= SURE_IOU)
    agreed = 0.5 * (first[mutual] + second[best[mutual]])
    alone = (box_iou(possible, agreed) < SAME_IOU).all(axis=1)
    return agreed, possible[alone]


def agree_on_joints(
    pose: PoseEstimator, image: Image, boxes: Floats
) -> tuple[Floats, NDArray[np.int8]]:
    """Return joints that a net puts in the same place in three views of each person.

    The views are the box, a wider box, and the mirrored image.

    Args:
        pose: estimator of COCO-17 keypoints.
        image: (height, width, 3) RGB.
        boxes: (people, 4) [px].

    Returns:
        (people, 17, 2) [px], NaN where the views disagree, and (people, 17) 2 or 0.
    """
    last = image.shape[1] - 1.0
    sides = boxes[:, 2:] - boxes[:, :2]
    wider = boxes + np.concatenate([-WIDER * sides, WIDER * sides], axis=1)
    turned = np.column_stack([last - boxes[:, 2], boxes[:, 1], last - boxes[:, 0], boxes[:, 3]])
    views = [pose.estimate(image, each) for each in (boxes, wider)]
    mirrored = pose.estimate(np.ascontiguousarray(image[:, ::-1]), turned)
    flip = list(COCO17_FLIP)
    back = mirrored.keypoints[:, flip] * [-1.0, 1.0] + [last, 0.0]
    places = np.stack([*(view.keypoints for view in views), back])
    confidence = np.stack([*(view.confidence for view in views), mirrored.confidence[:, flip]])
    middle = places.mean(axis=0)
    spread = np.linalg.norm(places - middle, axis=-1).max(axis=0)
    agreed = (spread < JOINT_SPREAD * sides[:, 1:]) & (confidence.min(axis=0) > JOINT_CONFIDENCE)
    agreed &= sides[:, 1:] > MIN_HEIGHT
    visible = np.where(agreed, 2, 0).astype(np.int8)
    return np.where(agreed[..., None], middle, np.nan), visible
