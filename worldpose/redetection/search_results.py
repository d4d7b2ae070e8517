"""Results of a pose estimator in predicted boxes, and their acceptance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import AnyFloats, Flags, Floats, Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection import People, PoseEstimator
from worldpose.detection.suppression import (
    combine_boxes,
    object_keypoint_similarity,
    surest_confidence,
)
from worldpose.filtering import (
    BodyViews,
    FilteringSettings,
    Spread,
    TriangulatedDetections,
    judge_detections,
)
from worldpose.geometry.boxes import box_areas, box_iou
from worldpose.redetection.expected import Expected
from worldpose.redetection.missing_people import MissingPeople
from worldpose.redetection.settings import RedetectionSettings

FEWEST: Final = 8
"""Least number of keypoints of a result [1]: half a body."""
FARTHEST: Final = 0.3
"""Cap on the distance between a joint and a keypoint [m]."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Classification of results; each is of one kind.

    Attributes:
        found: (n,) it is the person's.
        unsure: (n,) of low confidence, or there was no frame.
        elsewhere: (n,) it is not where the body is.
        another: (n,) it is another person's, or a duplicate.
        rejected: (n, 17) its keypoints that are not where the body is.
    """

    found: Flags
    unsure: Flags
    elsewhere: Flags
    another: Flags
    rejected: Flags


def search_missing_people(
    pictures: Iterable[tuple[int, Image | None]],
    sought: MissingPeople,
    estimator: PoseEstimator,
    least_keypoint: float,
    detected: AnyFloats | None = None,
) -> KeypointDetections:
    """Return the poses that an estimator finds in predicted boxes.

    The detections are those of the rows of `sought` (n,); they are missing where there was no
    image, and scores are comparable with those of a detector.

    Args:
        pictures: images by index of the frame, rising, at least the frames to search in.
        sought: people and boxes.
        estimator: of poses.
        least_keypoint: a keypoint below this confidence was not found [1].
        detected: (frames, detections, 4) boxes of detections [px]: an estimator may separate people
            by the boxes of their neighbours.
    """
    shape = (len(sought.frame), 17)
    found = KeypointDetections(
        keypoints=np.full((*shape, 2), np.nan),
        confidence=np.full(shape, np.nan),
        boxes=np.full((shape[0], 4), np.nan),
        score=np.full(shape[0], np.nan),
    )
    for frame, picture in pictures:
        rows = np.flatnonzero(sought.frame == frame)
        if picture is None or not len(rows):
            continue
        people = People(sought.boxes[rows], np.ones(len(rows)))
        beside = np.empty((0, 4)) if detected is None else detected[frame].astype(np.float64)
        beside = beside[np.isfinite(beside).all(axis=1)]
        beside = beside[(box_iou(people.boxes, beside) > 0.0).any(axis=0)]
        estimated = estimator.estimate(picture, np.concatenate([people.boxes, beside]))
        poses = combine_boxes(people, estimated.select(slice(len(rows))))
        with np.errstate(invalid="ignore"):
            there = (poses.confidence >= least_keypoint) & np.isfinite(poses.keypoints).all(axis=2)
        for name, values in poses.without(~there).arrays().items():
            found.arrays()[name][rows] = values
    plain = found.score >= 1.0  # of an estimator without boxes and fit
    found.score[plain] = np.clip(surest_confidence(found.confidence[plain]), 1e-3, 1.0)
    return found


def judge_search_results(
    results: KeypointDetections,
    sought: MissingPeople,
    expected: Expected,
    detected: KeypointDetections,
    spread: Spread,
    noise: tuple[float, float],
    settings: RedetectionSettings,
) -> Verdicts:
    """Return the classification of results.

    A result is accepted if the estimator is confident, if it agrees with the body within the
    uncertainty of both, and if it is no other person's: no other body explains it better, and
    neither a detection in the frame nor a better result has that pose already.

    Args:
        results: of the estimator.
        sought: the people of these results.
        expected: all bodies in view of the camera.
        detected: the detections (frames, detections) in all frames of the camera.
        spread: of keypoints around bodies.
        noise: stated standard deviation of keypoints, [px] and [m].
        settings: acceptance thresholds.
    """
    agrees, rejected = _compare_with_bodies(results, sought, expected, spread, noise, settings)
    unsure = ~(surest_confidence(results.confidence) >= settings.min_confidence)
    away = _distances(results, sought, expected)
    rows = np.arange(len(away))
    own = away[rows, sought.person]
    nearer = (away < own[:, None]).any(axis=1)
    elsewhere = ~unsure & ~agrees & ~nearer
    another = ~unsure & nearer
    open_ = ~unsure & ~elsewhere & ~another
    for frame in np.unique(sought.frame[open_]):
        here = np.flatnonzero(open_ & (sought.frame == frame))
        here = here[np.argsort(own[here], kind="stable")]
        boxes = np.concatenate([results.boxes[here], detected.boxes[frame]])
        pose = np.concatenate([results.keypoints[here], detected.keypoints[frame]])
        alike = object_keypoint_similarity(pose, np.nan_to_num(box_areas(boxes)))[: len(here)]
        same = np.asarray(alike > settings.oks_nms)
        for k, row in enumerate(here):
            before = same[k, :k] & ~another[here[:k]]
            another[row] = before.any() or same[k, len(here) :].any()
    return Verdicts(open_ & ~another, unsure, elsewhere, another, rejected)


def _compare_with_bodies(
    results: KeypointDetections,
    sought: MissingPeople,
    expected: Expected,
    spread: Spread,
    noise: tuple[float, float],
    settings: RedetectionSettings,
) -> tuple[Flags, Flags]:
    """Return which results (n,) agree with their bodies, and which of their keypoints do not."""
    count = len(sought.frame)
    at = sought.frame, sought.person
    image, variance, scale = (
        each[at][:, None, None] for each in (expected.image, expected.variance, expected.scale)
    )
    suspects = TriangulatedDetections(
        keypoints=results.keypoints[:, None, None],
        confidence=results.confidence[:, None, None],
        index=np.zeros((count, 1, 1), dtype=np.int64),
        offsets=np.zeros((count, 1, 1, 2)),
        exchanged=np.zeros((count, 1, 1, 3), dtype=np.bool_),
        dropped=np.zeros((count, 1, 1), dtype=np.bool_),
        noise=noise,
    )
    rules = FilteringSettings(
        max_deviation=settings.max_deviation,
        min_inlier_share=settings.min_inlier_share,
        min_similarity=settings.min_similarity,
        min_keypoints=FEWEST,
    )
    judged = judge_detections(BodyViews(image, variance, scale), suspects, spread, rules)
    return judged.fits[:, 0, 0] == 0, judged.rejected[:, 0, 0]


def _distances(results: KeypointDetections, sought: MissingPeople, expected: Expected) -> Floats:
    """Return mean distances (n, persons) of a result's keypoints to bodies of its frame [m]."""
    image, scale = expected.image[sought.frame], expected.scale[sought.frame]
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(results.keypoints[:, None] - image, axis=-1) / scale
    there = np.asarray(np.isfinite(results.keypoints).all(axis=-1))
    away = np.where(there[:, None], np.fmin(away, FARTHEST), 0.0)
    return np.asarray(away.sum(axis=-1) / np.maximum(there.sum(axis=-1), 1)[:, None])
