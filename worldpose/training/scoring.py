"""Metrics of the embedded nets on labelled frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image
from worldpose.detection.boxes import overlaps
from worldpose.detection.interfaces import Detector, People, PoseEstimator
from worldpose.detection.oks_nms import suppress_poses
from worldpose.detection.posed import find_poses
from worldpose.detection.settings import DetectionSettings
from worldpose.training.average_precision import average_precision
from worldpose.training.keypoint_accuracy import calibration_error, correct_keypoints
from worldpose.training.keypoint_training import RIGHT
from worldpose.training.labels import LabelledPicture
from worldpose.training.pictures import PictureCache

HEIGHTS = ((34.0, 46.0), (52.0, 70.0), (70.0, 160.0))
"""Classes of people's heights [px]: of about 40, of about 60, and taller."""


@dataclass(frozen=True)
class KeypointFigures:
    """Accuracy of keypoints in given boxes.

    Attributes:
        people: number of people.
        pck: share of visible keypoints within a fifth of the torso [1].
        hidden_pck: the same of occluded ones within the image [1]; NaN without.
        median_error: of visible keypoints, as a share of the longer side of the box [1].
        calibration: mean gap between confidence and share of correct keypoints [1].
    """

    people: int
    pck: float
    hidden_pck: float
    median_error: float
    calibration: float


def found_people(
    detector: Detector,
    pictures: Sequence[LabelledPicture],
    cache: PictureCache,
    estimator: PoseEstimator | None = None,
    settings: DetectionSettings | None = None,
) -> list[People]:
    """Return the people in each image; with an estimator, as the stage stores them."""
    found = [detector.detect([cache[picture.path]])[0] for picture in pictures]
    if estimator is None:
        return found
    return [
        stored(people, cache[picture.path], estimator, settings)
        for people, picture in zip(found, pictures, strict=True)
    ]


def score_people(
    found: Sequence[People],
    pictures: Sequence[LabelledPicture],
    heights: Sequence[tuple[float, float]] = HEIGHTS,
) -> tuple[float, ...]:
    """Return AP50 of all detections, and in each class of heights [px]."""
    classes = [(0.0, np.inf), *heights]
    return tuple(average_precision(found, pictures, each) for each in classes)


def stored(
    people: People,
    picture: Image,
    estimator: PoseEstimator,
    settings: DetectionSettings | None = None,
) -> People:
    """Return the people in an image as the stage stores them, the crowd included."""
    chosen = settings or DetectionSettings()
    kept = people.scores >= chosen.low_score_threshold
    people = People(people.boxes[kept], people.scores[kept])
    found = find_poses(estimator, picture, people, chosen)
    distinct = suppress_poses(found, chosen.min_keypoint_confidence, chosen.oks_nms)
    return People.from_detections(distinct)


def apart(pictures: Sequence[LabelledPicture], share: float = 0.3) -> list[LabelledPicture]:
    """Return the images with people ignored whose box overlaps another's more than `share`.

    Args:
        pictures: with the truth.
        share: intersection over union of two people's boxes [1].
    """
    kept = []
    for picture in pictures:
        common = overlaps(picture.boxes, picture.boxes)
        np.fill_diagonal(common, 0.0)
        crowded = (common > share).any(axis=1)
        kept.append(replace(picture, ignored=picture.ignored | crowded))
    return kept


def score_keypoints(
    estimator: PoseEstimator,
    pictures: Sequence[LabelledPicture],
    cache: PictureCache,
    heights: tuple[float, float] = (0.0, np.inf),
) -> KeypointFigures:
    """Return metrics of the people of some heights [px], each in the true box."""
    correct, visible, error, confidence, right = [], [], [], [], []
    for picture in pictures:
        tall = picture.boxes[:, 3] - picture.boxes[:, 1]
        asked = ~picture.ignored & (tall >= heights[0]) & (tall < heights[1])
        if not asked.any():
            continue
        boxes, true = picture.boxes[asked], picture.keypoints[asked]
        said = estimator.estimate(cache[picture.path], boxes)
        off = np.linalg.norm(said.keypoints - true, axis=-1)
        longer = np.max(boxes[:, 2:] - boxes[:, :2], axis=1)
        correct.append(correct_keypoints(said.keypoints, true))
        error.append(off / longer[:, None])
        right.append(off <= RIGHT * longer[:, None])
        visible.append(picture.visible[asked])
        confidence.append(said.confidence)
    if not correct:
        return KeypointFigures(0, *(np.nan,) * 4)
    good, seen = np.concatenate(correct), np.concatenate(visible)
    sure, fine = np.concatenate(confidence), np.concatenate(right)
    counted = np.isfinite(good) & np.isfinite(sure)

    def share(of: NDArray[np.bool_]) -> float:
        return float(np.mean(good[of & np.isfinite(good)])) if of.any() else np.nan

    return KeypointFigures(
        people=len(good),
        pck=share(seen == 2),
        hidden_pck=share(seen == 1),
        median_error=float(np.nanmedian(np.concatenate(error)[seen == 2])),
        calibration=calibration_error(sure[counted], fine[counted]),
    )
