"""Interfaces of person detectors and pose estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats, Image
from data_contracts.keypoints import KeypointDetections

MIN_SCORE: Final = 0.05
"""A detector reports every box from this score on; the stage applies its own thresholds."""


@dataclass(frozen=True)
class People:
    """People detected in one frame.

    Attributes:
        boxes: (people, 4) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel.
        scores: (people,) in (0, 1].
    """

    boxes: Floats
    scores: Floats

    @classmethod
    def from_detections(cls, detections: KeypointDetections) -> People:
        """Return the boxes and scores (people,) of one image's detections."""
        return cls(
            np.asarray(detections.boxes, np.float64), np.asarray(detections.score, np.float64)
        )

    @classmethod
    def concatenate(cls, parts: Sequence[People]) -> People:
        """Return the people of several detections of one frame."""
        boxes = np.concatenate([part.boxes for part in parts])
        return cls(boxes, np.concatenate([part.scores for part in parts]))

    def select(self, rows: Flags | NDArray[np.integer]) -> People:
        """Return some of the people (people,), by index or flag."""
        return People(self.boxes[rows], self.scores[rows])


@dataclass(frozen=True)
class ScoreMap:
    """Map of a net's scores to the probability that a box is a person's.

    The logit of the probability is a linear function of the logit of the score (Platt scaling of
    log odds). The slope is above 0, so that the order of boxes stays.
    """

    slope: float
    offset: float

    def probability(self, scores: AnyFloats) -> Floats:
        """Return the probability of each score [1], within (0, 1]; NaN stays NaN."""
        least = 1e-12  # a score of 0 would mean that there is no person
        score = np.clip(np.asarray(scores, dtype=np.float64), least, 1.0)
        with np.errstate(divide="ignore"):
            against = self.slope * (np.log1p(-score) - np.log(score)) - self.offset
        return np.asarray(np.maximum(1.0 / (1.0 + np.exp(against)), least))


class Detector(Protocol):
    """A detector of people in images; the same images give the same people."""

    @property
    def view_size(self) -> tuple[int, int] | None:
        """Width, height of the images that it takes best [px]; None if it takes any size.

        The caller cuts larger frames into overlapping views of this size.
        """

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each image, from `MIN_SCORE` on."""


class PoseEstimator(Protocol):
    """An estimator of the keypoints of people whose boxes are known."""

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box (people, 4) x0, y0, x1, y1 [px] of the whole frame.

        Keypoints are in frame pixels, and may lie outside of their box. Boxes of poses are as the
        estimator sees them in a crop, finer than a detector's, and their scores are the expected
        intersections over union of these and the true boxes; both are NaN from an estimator of
        joints alone.
        """


@runtime_checkable
class EstimatesFrames(PoseEstimator, Protocol):
    """An estimator for the frames of a batch together, which also finds occluded people."""

    def estimate_frames(
        self, images: Sequence[Image], boxes: Sequence[Floats]
    ) -> list[KeypointDetections]:
        """Return the poses in frames of one size, as `estimate` does in one."""

    def find_occluded(
        self, images: Sequence[Image], people: Sequence[People]
    ) -> list[KeypointDetections]:
        """Return people occluded by the detected ones, which a detector missed."""


class PointEstimator(Protocol):
    """An estimator of points besides COCO-17 of people whose boxes are known."""

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the points."""

    def add_points(
        self, images: Sequence[Image], people: Sequence[KeypointDetections]
    ) -> list[KeypointDetections]:
        """Return the people (people,) of whole frames of one size with these points and no others.

        They have boxes; none is a valid request.
        """
