"""Results of a pose estimator in predicted boxes, and their acceptance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Image
from worldpose.detection import People, PoseEstimator, Poses
from worldpose.detection.boxes import SUREST, areas, overlaps, seen_closer
from worldpose.detection.oks_nms import likeness
from worldpose.filtering import (
    BodyViews,
    FilteringSettings,
    Spread,
    Suspects,
    judge_detections,
)
from worldpose.redetection.expected import Expected
from worldpose.redetection.settings import RedetectionSettings
from worldpose.redetection.sought import Sought

FEWEST: Final = 8
"""Least number of keypoints of a result [1]: half a body."""
FARTHEST: Final = 0.3
"""Cap on the distance between a joint and a keypoint [m]."""


@dataclass(frozen=True, eq=False)
class Answers:
    """Estimated poses of the people searched for; NaN where there was no frame.

    Attributes:
        keypoints: (n, 17, 2) [px]; NaN where not found.
        confidence: (n, 17).
        boxes: (n, 4) [px].
        score: (n,) in (0, 1], comparable with those of detections.
    """

    keypoints: Floats
    confidence: Floats
    boxes: Floats
    score: Floats

    @classmethod
    def none(cls, count: int) -> Answers:
        """Return empty results for `count` people."""
        empty = (np.full((count, *shape), np.nan) for shape in ((17, 2), (17,), (4,), ()))
        return cls(*empty)

    @property
    def sureness(self) -> Floats:
        """Return the mean confidence of the surest keypoints (n,), 0 without any."""
        return np.asarray(np.sort(np.nan_to_num(self.confidence), axis=1)[:, -SUREST:].mean(axis=1))


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


def look_again(
    pictures: Iterable[tuple[int, Image | None]],
    sought: Sought,
    estimator: PoseEstimator,
    least_keypoint: float,
    detected: Floats | None = None,
) -> Answers:
    """Return the poses that an estimator finds in predicted boxes.

    Args:
        pictures: images by index of the frame, rising, at least the frames to search in.
        sought: people and boxes.
        estimator: of poses.
        least_keypoint: a keypoint below this confidence was not found [1].
        detected: (frames, detections, 4) boxes of detections [px]: an estimator may separate people
            by the boxes of their neighbours.
    """
    answers = Answers.none(len(sought.frame))
    for frame, picture in pictures:
        rows = np.flatnonzero(sought.frame == frame)
        if picture is None or not len(rows):
            continue
        people = People(sought.boxes[rows], np.ones(len(rows)))
        beside = np.empty((0, 4)) if detected is None else detected[frame].astype(np.float64)
        beside = beside[np.isfinite(beside).all(axis=1)]
        beside = beside[(overlaps(people.boxes, beside) > 0.0).any(axis=0)]
        everybody = estimator.estimate(picture, np.concatenate([people.boxes, beside]))
        poses = _first(everybody, len(rows))
        people = seen_closer(people, poses)
        with np.errstate(invalid="ignore"):
            there = (poses.confidence >= least_keypoint) & np.isfinite(poses.keypoints).all(axis=2)
        answers.keypoints[rows] = np.where(there[..., None], poses.keypoints, np.nan)
        answers.confidence[rows] = np.where(there, poses.confidence, np.nan)
        answers.boxes[rows] = people.boxes
        answers.score[rows] = people.scores
    plain = answers.score >= 1.0  # of an estimator without boxes and fit
    answers.score[plain] = np.clip(answers.sureness[plain], 1e-3, 1.0)
    return answers


def _first(poses: Poses, count: int) -> Poses:
    """Return the first `count` poses."""
    boxes, fit = (None if each is None else each[:count] for each in (poses.boxes, poses.fit))
    return Poses(poses.keypoints[:count], poses.confidence[:count], boxes, fit)


def judge_answers(
    answers: Answers,
    sought: Sought,
    expected: Expected,
    detected: tuple[Floats, Floats],
    spread: Spread,
    noise: tuple[float, float],
    settings: RedetectionSettings,
) -> Verdicts:
    """Return the classification of results.

    A result is accepted if the estimator is confident, if it agrees with the body within the
    uncertainty of both, and if it is no other person's: no other body explains it better, and
    neither a detection in the frame nor a better result has that pose already.

    Args:
        answers: of the estimator.
        sought: the people of these results.
        expected: all bodies in view of the camera.
        detected: keypoints (frames, detections, 17, 2) and boxes (frames, detections, 4) [px] of
            the detections in all frames.
        spread: of keypoints around bodies.
        noise: stated standard deviation of keypoints, [px] and [m].
        settings: acceptance thresholds.
    """
    agrees, rejected = _agreeing(answers, sought, expected, spread, noise, settings)
    unsure = ~(answers.sureness >= settings.min_confidence)
    away = _distances(answers, sought, expected)
    rows = np.arange(len(away))
    own = away[rows, sought.person]
    nearer = (away < own[:, None]).any(axis=1)
    elsewhere = ~unsure & ~agrees & ~nearer
    another = ~unsure & nearer
    open_ = ~unsure & ~elsewhere & ~another
    for frame in np.unique(sought.frame[open_]):
        here = np.flatnonzero(open_ & (sought.frame == frame))
        here = here[np.argsort(own[here], kind="stable")]
        boxes = np.concatenate([answers.boxes[here], detected[1][frame]])
        pose = np.concatenate([answers.keypoints[here], detected[0][frame]])
        alike = likeness(pose, np.nan_to_num(areas(boxes)))[: len(here)]
        same = np.asarray(alike > settings.oks_nms)
        for k, row in enumerate(here):
            before = same[k, :k] & ~another[here[:k]]
            another[row] = before.any() or same[k, len(here) :].any()
    return Verdicts(open_ & ~another, unsure, elsewhere, another, rejected)


def _agreeing(
    answers: Answers,
    sought: Sought,
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
    suspects = Suspects(
        keypoints=answers.keypoints[:, None, None],
        confidence=answers.confidence[:, None, None],
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


def _distances(answers: Answers, sought: Sought, expected: Expected) -> Floats:
    """Return mean distances (n, persons) of a result's keypoints to bodies of its frame [m]."""
    image, scale = expected.image[sought.frame], expected.scale[sought.frame]
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(answers.keypoints[:, None] - image, axis=-1) / scale
    there = np.asarray(np.isfinite(answers.keypoints).all(axis=-1))
    away = np.where(there[:, None], np.fmin(away, FARTHEST), 0.0)
    return np.asarray(away.sum(axis=-1) / np.maximum(there.sum(axis=-1), 1)[:, None])
