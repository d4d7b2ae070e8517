"""What a pose estimator answers where people are sought, and whose poses those are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.detection import People, PoseEstimator, Poses
from worldpose.detection.boxes import SUREST, areas, overlaps, seen_closer
from worldpose.detection.interfaces import Picture
from worldpose.detection.same_pose import likeness
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

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

FEWEST: Final = 8
"""Keypoints that an answer must have [1]: half a body."""
FARTHEST: Final = 0.3
"""A joint that is farther from a keypoint counts as this far [m]."""


@dataclass(frozen=True, eq=False)
class Answers:
    """What was seen of each who is sought; NaN where there was no picture.

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
        """Nothing of so many."""
        empty = (np.full((count, *shape), np.nan) for shape in ((17, 2), (17,), (4,), ()))
        return cls(*empty)

    @property
    def sureness(self) -> Floats:
        """Mean confidence of the surest keypoints (n,), 0 without any."""
        return np.asarray(np.sort(np.nan_to_num(self.confidence), axis=1)[:, -SUREST:].mean(axis=1))


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Which answers are the person's; each is of one kind.

    Attributes:
        found: (n,) it is.
        unsure: (n,) the estimator itself doubts it, or there was no picture.
        elsewhere: (n,) it is not where the body is.
        another: (n,) it is somebody else's, or there already.
        rejected: (n, 17) keypoints of it that are not where the body is.
    """

    found: Flags
    unsure: Flags
    elsewhere: Flags
    another: Flags
    rejected: Flags


def look_again(
    pictures: Iterable[tuple[int, Picture | None]],
    sought: Sought,
    estimator: PoseEstimator,
    least_keypoint: float,
    detected: Floats | None = None,
) -> Answers:
    """Return what an estimator sees where people should be.

    Args:
        pictures: by place among the frames, rising, at least those with somebody sought.
        sought: who, and where.
        estimator: of poses.
        least_keypoint: a keypoint below this confidence was not found [1].
        detected: (frames, detections, 4) boxes of who was detected [px]: an estimator may tell
            people apart by where their neighbours stand.
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
    plain = answers.score >= 1.0  # of an estimator that tells no more
    answers.score[plain] = np.clip(answers.sureness[plain], 1e-3, 1.0)
    return answers


def _first(poses: Poses, count: int) -> Poses:
    """Return the poses of the first so many."""
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
    """Return which answers are of whom they were sought for.

    An answer counts where the estimator is sure of it, where it agrees with the body within what
    both are unsure of, and where it is nobody else's: no other body explains it better, no
    detection of the picture has that pose already, nor has a better answer.

    Args:
        answers: of the estimator.
        sought: whom they are for.
        expected: all bodies before the camera.
        detected: keypoints (frames, detections, 17, 2) and boxes (frames, detections, 4) [px] of
            those who were detected in all frames.
        spread: of keypoints about bodies.
        noise: what keypoints are stated to err by, [px] and [m].
        settings: what an answer must fulfil.
    """
    agrees, rejected = _agreeing(answers, sought, expected, spread, noise, settings)
    unsure = ~(answers.sureness >= settings.least_confidence)
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
        same = np.asarray(alike > settings.same_pose)
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
    """Which answers (n,) the bodies do not contradict, and which of their keypoints they do."""
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
        least_fitting=settings.least_fitting,
        least_similarity=settings.least_similarity,
        fewest=FEWEST,
    )
    judged = judge_detections(BodyViews(image, variance, scale), suspects, spread, rules)
    return judged.fits[:, 0, 0] == 0, judged.rejected[:, 0, 0]


def _distances(answers: Answers, sought: Sought, expected: Expected) -> Floats:
    """Mean distances (n, persons) of an answer's keypoints to bodies of its frame [m]."""
    image, scale = expected.image[sought.frame], expected.scale[sought.frame]
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(answers.keypoints[:, None] - image, axis=-1) / scale
    there = np.asarray(np.isfinite(answers.keypoints).all(axis=-1))
    away = np.where(there[:, None], np.fmin(away, FARTHEST), 0.0)
    return np.asarray(away.sum(axis=-1) / np.maximum(there.sum(axis=-1), 1)[:, None])
