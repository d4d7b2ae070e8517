"""People in one camera's video: boxes, then keypoints, in chunks of frames (D1-D3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image
from worldpose.detection.boxes import areas, fuse, suppress
from worldpose.detection.crowd import on_pitch
from worldpose.detection.followed import Follower, looked_at
from worldpose.detection.interfaces import Detector, People, PoseEstimator, Poses
from worldpose.detection.oks_nms import told_apart
from worldpose.detection.posed import find_poses
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.views import Tiled
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate

STRETCH: Final = 64
"""Frames per chunk."""


@dataclass(frozen=True)
class Stretch:
    """People in a chunk of consecutive frames, in the form of given 2D poses.

    Attributes:
        keypoints: (frames, most_people, 17, 2) float32 [px]; NaN where not found.
        confidence: (frames, most_people, 17) float32.
        boxes: (frames, most_people, 4) float32 [px].
        score: (frames, most_people) float32.
        unreadable: numbers of frames without an image.
    """

    keypoints: NDArray[np.float32]
    confidence: NDArray[np.float32]
    boxes: NDArray[np.float32]
    score: NDArray[np.float32]
    unreadable: tuple[int, ...]

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return the arrays by name, as they are stored."""
        return {
            "keypoints": self.keypoints,
            "confidence": self.confidence,
            "boxes": self.boxes,
            "score": self.score,
        }


@dataclass
class DetectionReport:
    """Counts of a detection run; complete after the last chunk.

    Attributes:
        frames: requested.
        unreadable: frames without an image.
        empty: frames with an image and without people.
        detections: people in all frames.
        crowd: boxes outside of the pitch.
        bridged: boxes that were filled in.
        flickers: boxes of tracks with too few sightings.
        unsure: people without a single keypoint, or with the pose of a better box.
        beside: occluded people found next to others; later steps may drop some.
    """

    frames: int = 0
    unreadable: int = 0
    empty: int = 0
    detections: int = 0
    crowd: int = 0
    bridged: int = 0
    flickers: int = 0
    unsure: int = 0
    beside: int = 0


@dataclass(frozen=True)
class Place:
    """Camera and pitch, which separate the crowd from the players.

    Attributes:
        camera: the calibrated camera.
        pitch: the pitch in its view.
    """

    camera: Camera
    pitch: PitchTemplate


class PeopleFinder:
    """Detectors, an estimator and settings, for the videos of a match.

    Attributes:
        report: of the last video.
    """

    def __init__(
        self, detectors: Sequence[Detector], estimator: PoseEstimator, settings: DetectionSettings
    ) -> None:
        """Combine detectors, an estimator and settings.

        Args:
            detectors: one, or an ensemble.
            estimator: finds keypoints in boxes.
            settings: of the stage.
        """
        self._detectors = [
            detector
            if detector.view_size is None
            else Tiled(detector, settings.zooms, settings.view_overlap, settings.nms_iou)
            for detector in detectors
        ]
        self._estimator, self._settings = estimator, settings
        self.report = DetectionReport()

    def find(
        self, frames: Iterable[tuple[int, Image | None]], place: Place | None = None
    ) -> Iterator[Stretch]:
        """Yield the people of a video in chunks of frames.

        Args:
            frames: numbers that rise by one, each with its image; None where there is none.
            place: camera and pitch; None keeps the crowd.
        """
        self.report = DetectionReport()
        follower = Follower(self._settings)
        looked = looked_at(
            frames,
            lambda pictures: self._people(pictures, place),
            self._settings.stride,
            self._settings.batch,
        )
        rows: list[tuple[People, Poses]] = []
        unreadable: list[int] = []
        for number, picture, people in follower.follow(looked):
            if picture is None:
                unreadable.append(number)
                rows.append((_nobody(), Poses(np.empty((0, 17, 2)), np.empty((0, 17)))))
            else:
                rows.append(self._posed(picture, people, place))
            if len(rows) == STRETCH:
                yield self._stretch(rows, unreadable)
        if rows:
            yield self._stretch(rows, unreadable)
        self.report.bridged, self.report.flickers = follower.bridged, follower.flickers

    def _people(self, pictures: list[Image], place: Place | None) -> list[People]:
        """Return the people on the pitch in each frame."""
        settings = self._settings
        found = [detector.detect(pictures) for detector in self._detectors]
        everybody = []
        for members in zip(*found, strict=True):
            if settings.fusion == "weighted":
                people = fuse(list(members), settings.nms_iou)
            else:
                together = People(
                    np.concatenate([member.boxes for member in members]),
                    np.concatenate([member.scores for member in members]),
                )
                people = suppress(together, settings.nms_iou)
            kept = (people.scores >= settings.low_score_threshold) & (areas(people.boxes) > 0.0)
            people = People(people.boxes[kept], people.scores[kept])
            if place is not None:
                inside = self._inside(people, pictures[0], place)
                self.report.crowd += int(np.count_nonzero(~inside))
                people = People(people.boxes[inside], people.scores[inside])
            everybody.append(people)
        return everybody

    def _inside(self, people: People, picture: Image, place: Place) -> NDArray[np.bool_]:
        """Return whether people's feet are on the pitch or near it (people,)."""
        size = (picture.shape[1], picture.shape[0])
        margin = self._settings.pitch_margin_m
        return on_pitch(people.boxes, place.camera, size, place.pitch, margin)

    def _posed(self, picture: Image, people: People, place: Place | None) -> tuple[People, Poses]:
        """Return keypoints of people; drop those without any or with the pose of a better box."""
        found = len(people.scores)
        people, poses = find_poses(self._estimator, picture, people, self._settings)
        self.report.beside += len(people.scores) - found
        if place is not None:
            # Detected people are on the pitch; a person they occlude may be a bystander.
            kept = self._inside(people, picture, place) | (np.arange(len(people.scores)) < found)
            people = People(people.boxes[kept], people.scores[kept])
            poses = Poses(poses.keypoints[kept], poses.confidence[kept])
        known, own = told_apart(
            people, poses, self._settings.min_keypoint_confidence, self._settings.oks_nms
        )
        self.report.unsure += len(people.scores) - len(known.scores)
        best = np.sort(np.argsort(-known.scores, kind="stable")[: self._settings.max_people])
        return (
            People(known.boxes[best], known.scores[best]),
            Poses(own.keypoints[best], own.confidence[best]),
        )

    def _stretch(self, rows: list[tuple[People, Poses]], unreadable: list[int]) -> Stretch:
        shape = (len(rows), self._settings.max_people)
        stretch = Stretch(
            keypoints=np.full((*shape, 17, 2), np.nan, dtype=np.float32),
            confidence=np.full((*shape, 17), np.nan, dtype=np.float32),
            boxes=np.full((*shape, 4), np.nan, dtype=np.float32),
            score=np.full(shape, np.nan, dtype=np.float32),
            unreadable=tuple(unreadable),
        )
        for row, (people, poses) in enumerate(rows):
            count = len(people.scores)
            stretch.keypoints[row, :count] = poses.keypoints
            stretch.confidence[row, :count] = poses.confidence
            stretch.boxes[row, :count] = people.boxes
            stretch.score[row, :count] = people.scores
            self.report.detections += count
        self.report.frames += len(rows)
        self.report.unreadable += len(unreadable)
        self.report.empty += sum(not len(people.scores) for people, _ in rows) - len(unreadable)
        rows.clear()
        unreadable.clear()
        return stretch


def _nobody() -> People:
    return People(np.empty((0, 4)), np.empty(0))
