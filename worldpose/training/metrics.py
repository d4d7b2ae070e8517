"""Metrics on labelled frames: AP50 of boxes, accuracy (PCK) and calibration of keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import AnyFloats, Flags, Floats, Image, Integers
from worldpose.detection.interfaces import Detector, People, PoseEstimator
from worldpose.detection.pipeline import find_poses
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import suppress_poses
from worldpose.geometry.boxes import box_iou
from worldpose.training.labels import LabelledPicture, PictureCache

MAX_ERROR_SHARE: Final = 0.05
"""A keypoint is correct within this share of the box's longer side [1], a fifth of a torso."""


@dataclass(frozen=True)
class KeypointMetrics:
    """Accuracy of keypoints in given boxes of so many people.

    Attributes:
        pck: share of visible keypoints within a fifth of the torso [1].
        median_error: of visible keypoints, as a share of the longer side of the box [1].
        calibration: mean gap between confidence and share of correct keypoints [1].
    """

    people: int
    pck: float
    median_error: float
    calibration: float


def detect_labelled(
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
        stored_people(people, cache[picture.path], estimator, settings)
        for people, picture in zip(found, pictures, strict=True)
    ]


def stored_people(
    people: People,
    picture: Image,
    estimator: PoseEstimator,
    settings: DetectionSettings | None = None,
) -> People:
    """Return the people in an image as stored, crowd included, with scores before `ScoreMap`."""
    chosen = settings or DetectionSettings()
    kept = people.scores >= chosen.low_score_threshold
    people = people.select(kept)
    (found,) = find_poses(estimator, [picture], [people], chosen)
    distinct = suppress_poses(found, chosen.min_keypoint_confidence, chosen.oks_nms)
    return People.from_detections(distinct)


def score_keypoints(
    estimator: PoseEstimator,
    pictures: Sequence[LabelledPicture],
    cache: PictureCache,
    heights: tuple[float, float] = (0.0, np.inf),
) -> KeypointMetrics:
    """Return keypoint metrics of people in their true boxes, within a range of heights [px]."""
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
        right.append(off <= MAX_ERROR_SHARE * longer[:, None])
        visible.append(picture.visible[asked])
        confidence.append(said.confidence)
    if not correct:
        return KeypointMetrics(0, *(np.nan,) * 3)
    good, seen = np.concatenate(correct), np.concatenate(visible)
    sure, fine = np.concatenate(confidence), np.concatenate(right)
    counted = np.isfinite(good) & np.isfinite(sure)

    def share(of: Flags) -> float:
        return float(np.mean(good[of & np.isfinite(good)])) if of.any() else np.nan

    return KeypointMetrics(
        people=len(good),
        pck=share(seen == 2),
        median_error=float(np.nanmedian(np.concatenate(error)[seen == 2])),
        calibration=calibration_error(sure[counted], fine[counted]),
    )


def average_precision(
    found: Sequence[People],
    labels: Sequence[LabelledPicture],
    heights: tuple[float, float] = (0.0, np.inf),
) -> float:
    """Return the area under the curve of precision over recall [1]; NaN without wanted people.

    As in COCO, the best boxes choose first, and each chooses the person that it overlaps most.
    Ignored people, people of other heights, and boxes on them count neither as true nor as false
    positives. The same applies to boxes of other heights that match no person. The range of wanted
    heights [px] includes its lower bound, not the upper. `labels` are of the images of `found`.
    """
    scores, right = [], []
    asked = 0
    for people, picture in zip(found, labels, strict=True):
        tall = picture.boxes[:, 3] - picture.boxes[:, 1]
        wanted = ~picture.ignored & (tall >= heights[0]) & (tall < heights[1])
        asked += int(wanted.sum())
        order = np.argsort(-people.scores, kind="stable")
        verdict = _match_boxes(people.boxes[order], picture.boxes, wanted)
        own = people.boxes[order, 3] - people.boxes[order, 1]
        stray = (verdict == 0) & ((own < heights[0]) | (own >= heights[1]))
        counted = (verdict >= 0) & ~stray
        scores.append(people.scores[order][counted])
        right.append(verdict[counted] == 1)
    if asked == 0:
        return np.nan
    order = np.argsort(-np.concatenate(scores), kind="stable")
    hits = np.concatenate(right)[order]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(best[hits].sum() / asked)


def _match_boxes(boxes: Floats, true: Floats, wanted: Flags) -> Integers:
    """Return per box, best first: 1 true positive, 0 false positive, -1 on an ignored person."""
    min_true_iou = 0.5  # least intersection over union of a true positive [1]
    verdict = np.zeros(len(boxes), dtype=np.int64)
    if not len(true):
        return verdict
    overlap = box_iou(boxes, true)
    free = wanted.copy()
    for index, row in enumerate(overlap):
        best = int(np.where(free, row, -1.0).argmax())
        if free[best] and row[best] >= min_true_iou:
            verdict[index], free[best] = 1, False
        elif np.any(row[~wanted] >= min_true_iou):
            verdict[index] = -1
    return verdict


def judge_boxes(people: People, picture: LabelledPicture) -> tuple[Floats, Flags]:
    """Return scores (boxes,) of the boxes that count, best first, and which are right.

    A box is right if it overlaps a person whom no better box has. Boxes on ignored people do not
    count.
    """
    order = np.argsort(-people.scores, kind="stable")
    verdict = _match_boxes(people.boxes[order], picture.boxes, ~picture.ignored)
    counted = verdict >= 0
    return people.scores[order][counted], verdict[counted] == 1


def correct_keypoints(found: AnyFloats, true: Floats) -> Floats:
    """Return 1 for keypoints within a fifth of the torso, else 0 (people, 17); NaN without truth.

    A torso is as long as the longer diagonal from a shoulder to the other side's hip. Keypoints are
    (people, 17, 2) [px]; a missing one is not correct.
    """
    error = np.linalg.norm(found - true, axis=-1)
    torso = np.linalg.norm(true[:, (5, 6)] - true[:, (12, 11)], axis=-1).max(axis=-1)
    known = np.isfinite(true).all(axis=-1) & np.isfinite(torso)[:, None]
    return np.where(known, error <= 0.2 * torso[:, None], np.nan)


def calibration_error(confidence: Floats, right: Flags, classes: int = 10) -> float:
    """Return the mean gap between confidence and share of correct ones [1], over equal bins.

    Confidences (keypoints,) in (0, 1] and `right` (keypoints,) are in `classes` bins of equally
    many.
    """
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, min(classes, len(order)))
    gaps = [abs(confidence[part].mean() - right[part].mean()) * len(part) for part in parts]
    return float(np.sum(gaps) / len(order))
