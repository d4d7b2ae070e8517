"""Label proposals of detectors for chosen frames, for people to correct (D3-D4)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from data_contracts.arrays import Image
from worldpose.detection import DetectionSettings, Detector, People, PoseEstimator
from worldpose.detection.boxes import combine_boxes, fuse
from worldpose.training.labels import LabelledPicture, write_labels

SEEN: Final = 0.5
"""Keypoints from this confidence on are proposed as visible, others as occluded [1]."""


def propose_labels(
    frames: Iterable[tuple[str, Image]],
    detectors: list[Detector],
    pose: PoseEstimator,
    folder: Path,
    settings: DetectionSettings | None = None,
) -> list[LabelledPicture]:
    """Write detections in frames as a COCO data set and return them.

    The folder then holds pictures/<name>.png and labels.json, for any editor of COCO keypoints and
    for `read_labels`. The write is atomic: a failure leaves nothing that prevents a retry.

    Args:
        frames: name and image of each, in the order of recording, all of one size.
        detectors: an ensemble; its boxes of one person become one.
        pose: estimator of the keypoints.
        folder: absent or empty.
        settings: thresholds of proposals; the defaults if None.
    """
    place = folder.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as workshop:
        # One level down: a temporary folder is private, the labels have the usual rights.
        draft = Path(workshop) / place.name
        proposed = _write(frames, detectors, pose, draft, settings or DetectionSettings())
        draft.rename(place)  # replaces an empty folder, fails on any other
    return [replace(each, path=folder / each.path.relative_to(draft)) for each in proposed]


def _write(
    frames: Iterable[tuple[str, Image]],
    detectors: list[Detector],
    pose: PoseEstimator,
    folder: Path,
    settings: DetectionSettings,
) -> list[LabelledPicture]:
    (folder / "pictures").mkdir(parents=True)
    proposed, size = [], (0, 0)
    for name, picture in frames:
        people = fuse([each.detect([picture])[0] for each in detectors], settings.nms_iou)
        sure = people.scores >= settings.high_score_threshold
        kept = People(people.boxes[sure], people.scores[sure])
        poses = combine_boxes(kept, pose.estimate(picture, kept.boxes))
        found = poses.confidence >= settings.min_keypoint_confidence
        path = folder / "pictures" / f"{name}.png"
        cv2.imwrite(str(path), picture[..., ::-1])
        visible = np.where(poses.confidence >= SEEN, 2, 1) * found
        proposed.append(
            LabelledPicture(
                path=path,
                boxes=np.asarray(poses.boxes, dtype=np.float64),
                keypoints=np.where(found[..., None], poses.keypoints, np.nan),
                visible=visible.astype(np.int8),
                ignored=np.zeros(len(poses.boxes), dtype=np.bool_),
            )
        )
        size = (picture.shape[1], picture.shape[0])
    write_labels(folder / "labels.json", proposed, size)
    return proposed
