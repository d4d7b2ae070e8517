"""People in one camera's video: boxes, then keypoints, in chunks of frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from time import perf_counter
from typing import Final

import numpy as np

from data_contracts.arrays import AnyFloats, Flags, Floats, Image
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import read_ahead
from worldpose.detection.box_tracking import BoxCleaner, detect_strided
from worldpose.detection.enlargement import Part, SeesParts, expect_parts
from worldpose.detection.interfaces import (
    Detector,
    EstimatesFrames,
    People,
    PointEstimator,
    PoseEstimator,
    ScoreMap,
)
from worldpose.detection.models import load_detectors, load_landmarks, load_pose, load_score_map
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import combine_boxes, fuse, suppress, suppress_poses
from worldpose.detection.turning import QuarterTurn
from worldpose.detection.views import as_frame_detector
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_areas
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate


def on_pitch(
    boxes: Floats, camera: Camera, image_size: tuple[int, int], pitch: PitchTemplate, margin: float
) -> Flags:
    """Return whether people stand on the pitch or within a margin [m] around it (people,).

    The middle of a box's lower edge is where the feet touch the ground. The ray to a spectator in a
    stand meets the ground farther away than any margin. If the image border cuts off the feet, the
    head position decides, at a person's height above the ground. Boxes are (people, 4) x0, y0, x1,
    y1 [px], images of a width, height [px].
    """
    # The lower border cuts off a box that ends this near to it [px].
    cut = boxes[:, 3] > image_size[1] - 1 - 3.0
    pixels = np.stack(
        [boxes[:, [0, 2]].mean(axis=1), np.where(cut, boxes[:, 1], boxes[:, 3])], axis=1
    )
    rays = camera.unproject(pixels)
    # Height of the head above the ground, for a person whose feet the lower border cuts off [m].
    head_height = 1.75
    height = np.where(cut, head_height, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(3):  # the crown is flat: the second step changes millimetres
            along = (height - rays.origins[:, 2]) / rays.directions[:, 2]
            points = rays.origins + along[:, None] * rays.directions
            inside = np.isfinite(points).all(axis=1)
            ground = pitch.height(
                np.clip(np.where(inside, points[:, 0], 0.0), -pitch.length / 2, pitch.length / 2),
                np.clip(np.where(inside, points[:, 1], 0.0), -pitch.width / 2, pitch.width / 2),
            )
            height = np.where(cut, head_height, 0.0) + ground
        return np.asarray(
            inside
            & (along > 0.0)
            & (np.abs(points[:, 0]) <= pitch.length / 2 + margin)
            & (np.abs(points[:, 1]) <= pitch.width / 2 + margin)
        )


NO_PEOPLE: Final = People(np.empty((0, 4)), np.empty(0))
"""A frame without people."""


@dataclass
class DetectionReport:
    """Counts of a detection run; complete after the last chunk.

    Attributes:
        frames: requested.
        unreadable: numbers of the frames without an image.
        empty: frames with an image and without people.
        detections: people in all frames.
        boxes: boxes of the detectors, from `low_score_threshold` on.
        crowd: those of them that are outside of the pitch.
        bridged: boxes that were filled in.
        flickers: boxes of tracks with too few sightings.
        unsure: people without a single keypoint, or with the pose of a better box.
        cut: frames in which people beyond `max_people` were left out.
        beside: occluded people found next to others; later steps may drop some.
        is_given: whether the boxes were given, not detected.
        quarters: turns of the images by 90 degrees, counterclockwise, for the nets.
        seconds: of the clock, waiting for images, finding boxes, and finding poses.
    """

    frames: int = 0
    unreadable: list[int] = field(default_factory=list)
    empty: int = 0
    detections: int = 0
    boxes: int = 0
    crowd: int = 0
    bridged: int = 0
    flickers: int = 0
    unsure: int = 0
    cut: int = 0
    beside: int = 0
    is_given: bool = False
    quarters: int = 0
    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("images", "boxes", "poses"), 0.0)
    )

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add the time of a block to that of a part."""
        begun = perf_counter()
        yield
        self.seconds[part] += perf_counter() - begun

    def speed(self) -> dict[str, float]:
        """Return images per second, and the share of the time of each part [1]."""
        whole = max(sum(self.seconds.values()), 1e-9)
        shares = {f"{part}_share": each / whole for part, each in self.seconds.items()}
        return {"images_per_s": self.frames / whole, **shares}

    def why_no_person(self) -> str | None:
        """Return the likely reason why a clip of 20 frames or more shows no person; else None."""
        frames = self.frames - len(self.unreadable)
        if self.detections or frames < 20:
            return None
        found = f"no person in {frames} frames: "
        if self.is_given:
            return found + (
                f"the given file has {self.boxes} boxes in them. Check that its frames are those "
                "of this camera's video, from 1 on, and detection.pose"
            )
        if not self.boxes:
            return found + (
                "the detector gave no box from detection.low_score_threshold on. Check that "
                "detection.detector names a person detector and, for an ONNX file, its form "
                "(onnx-FORM:FILE), and that people are high enough in the images "
                "(detection.zooms enlarges them)"
            )
        if self.crowd == self.boxes:
            return found + (
                f"all {self.boxes} boxes of the detector lie outside of the pitch. Check the "
                "camera's calibration and its clicks"
            )
        return found + (
            f"of {self.boxes} boxes of the detector {self.crowd} lie outside of the pitch, "
            f"{self.flickers} are in too few frames (detection.min_hits), and the pose net found "
            f"no distinct person in {self.unsure}. Check detection.pose and these settings"
        )


@dataclass(frozen=True)
class Place:
    """Camera and pitch, which separate crowd from players; without a pitch, everyone counts."""

    camera: Camera
    pitch: PitchTemplate | None


class PeopleFinder:
    """Detectors, an estimator and settings, for a match's videos; `report` is the last one's."""

    def __init__(
        self,
        detectors: Sequence[Detector],
        estimator: PoseEstimator,
        settings: DetectionSettings,
        score_map: ScoreMap | None = None,
        landmarks: PointEstimator | None = None,
    ) -> None:
        """Combine detectors, one or an ensemble, an estimator and settings.

        The settings' thresholds apply to the nets' own scores; at the very end, `score_map` makes
        probabilities of them, None = not known. `landmarks` finds points besides COCO-17; None =
        none.
        """
        self._detectors = [as_frame_detector(each, settings) for each in detectors]
        self._estimator, self._settings, self._score_map = estimator, settings, score_map
        self._landmarks = landmarks
        self._parts: list[Part] | None = None
        self._most = settings.max_people
        self.report = DetectionReport()

    def find(
        self,
        frames: Iterable[tuple[int, Image | None]],
        place: Place | None = None,
        given: Mapping[int, People] | None = None,
    ) -> Iterator[KeypointDetections]:
        """Yield the people of a video in chunks of frames.

        Nets know people who stand: images of a camera that the calibration shows to be mounted on
        its side or upside down are turned, if the nets then find more in some of them.

        Numbers of frames rise by one, each with its image (height, width, 3) RGB of bytes, None
        where there is none. Without a place, the crowd stays. Known people, `given` by frame,
        replace those of the detectors, and all stay: no box is added, left out because of its score
        or its place, or tracked. InputError for an image of another form or size than the first, or
        the camera's.
        """
        frames = _require_rgb(frames, place)
        self.report = DetectionReport(is_given=given is not None)
        turn = None if place is None else QuarterTurn.of(place.camera)
        if turn is None or place is None:
            yield from self._find(frames, place, given)
            return
        first = list(islice(frames, 16))
        frames = chain(first, frames)
        if given is None and not self._are_upright([image for _, image in first], turn):
            yield from self._find(frames, place, given)
            return
        self.report.quarters = turn.quarters
        turned = ((number, turn.image(image)) for number, image in frames)
        upright = Place(turn.camera(place.camera), place.pitch)
        boxes = None if given is None else turn.people(given)
        for chunk in self._find(turned, upright, boxes):
            yield turn.turn_back(chunk)

    def _are_upright(self, images: Sequence[Image | None], turn: QuarterTurn) -> bool:
        """Return whether the detectors find as much in some images after a turn as before it."""
        some = [image for image in images if image is not None][::4]
        turned = [image for image in map(turn.image, some) if image is not None]
        before, after = (
            sum(
                float(people.scores[people.scores >= self._settings.high_score_threshold].sum())
                for detector in self._detectors
                for people in detector.detect(views)
            )
            for views in (some, turned)
        )
        return after >= before  # without people, the calibration decides

    def _find(
        self,
        frames: Iterable[tuple[int, Image | None]],
        place: Place | None,
        given: Mapping[int, People] | None,
    ) -> Iterator[KeypointDetections]:
        """Yield the people of upright images as `find` does."""
        # Frames decoded while earlier ones are searched.
        frames = self._wait_for(read_ahead(frames, 8))
        cleaner, self._most = BoxCleaner(self._settings), self._settings.max_people
        self._parts = None
        if (
            place is not None
            and place.pitch is not None
            and any(isinstance(each, SeesParts) for each in self._detectors)
        ):
            margin = self._settings.pitch_margin_m
            self._parts = expect_parts(place.camera, place.pitch, margin)
        if given is None:
            found = cleaner.clean(
                detect_strided(frames, lambda images: self._people(images, place), self._settings)
            )
        else:
            found = ((number, image, given.get(number, NO_PEOPLE)) for number, image in frames)
            counts = [len(people.scores) for people in given.values()]
            self.report.boxes = sum(counts)
            self._most = max(self._most, *counts, 0)
        rows: list[KeypointDetections] = []
        numbers: list[int] = []
        while batch := list(islice(found, self._settings.batch)):
            numbers += [number for number, _, _ in batch]
            with self.report.timed("poses"):
                rows += self._find_poses([(image, people) for _, image, people in batch], place)
            self.report.unreadable += [number for number, image, _ in batch if image is None]
            # Frames per chunk.
            if len(rows) >= 64:
                yield self._chunk(numbers, rows)
                rows, numbers = [], []
        if rows:
            yield self._chunk(numbers, rows)
        self.report.bridged, self.report.flickers = cleaner.bridged, cleaner.flickers

    def _wait_for(
        self, frames: Iterator[tuple[int, Image | None]]
    ) -> Iterator[tuple[int, Image | None]]:
        while True:
            with self.report.timed("images"):
                frame = next(frames, None)
            if frame is None:
                return
            yield frame

    def _people(self, images: list[Image], place: Place | None) -> list[People]:
        """Return the people on the pitch in each frame."""
        settings = self._settings
        with self.report.timed("boxes"):
            found = [
                detector.detect(images)
                if self._parts is None or not isinstance(detector, SeesParts)
                else detector.detect_parts(images, self._parts)
                for detector in self._detectors
            ]
        people_by_frame = []
        for members in zip(*found, strict=True):
            if settings.fusion == "weighted":
                people = fuse(list(members), settings.nms_iou)
            else:
                people = suppress(People.concatenate(members), settings.nms_iou)
            kept = (people.scores >= settings.low_score_threshold) & (box_areas(people.boxes) > 0.0)
            people_by_frame.append(people.select(kept))
            self.report.boxes += int(np.count_nonzero(kept))
        inside = self._inside([people.boxes for people in people_by_frame], images, place)
        self.report.crowd += sum(int(np.count_nonzero(~each)) for each in inside)
        return [people.select(each) for people, each in zip(people_by_frame, inside, strict=True)]

    def _inside(
        self, boxes: Sequence[AnyFloats], images: Sequence[Image], place: Place | None
    ) -> list[Flags]:
        """Return whether people's feet are on the pitch or near it (people,), for each frame."""
        if place is None or place.pitch is None or not images:
            return [np.ones(len(each), dtype=np.bool_) for each in boxes]
        size = (images[0].shape[1], images[0].shape[0])
        margin = self._settings.pitch_margin_m
        together = np.concatenate(boxes).astype(np.float64)
        inside = on_pitch(together, place.camera, size, place.pitch, margin)
        return np.split(inside, np.cumsum([len(each) for each in boxes])[:-1])

    def _find_poses(
        self, batch: Sequence[tuple[Image | None, People]], place: Place | None
    ) -> list[KeypointDetections]:
        """Return the people of frames with keypoints; none of frames without an image.

        People without keypoints, or with the pose of a better box, are dropped.
        """
        settings = self._settings
        if self.report.is_given:  # those found beside them would displace some
            settings = settings.model_copy(update={"find_occluded": False})
        images = [image for image, _ in batch if image is not None]
        people = [people for image, people in batch if image is not None]
        found = find_poses(self._estimator, images, people, settings)
        # Detected people are on the pitch; a person they occlude may be a bystander.
        inside = self._inside([each.boxes for each in found], images, place)
        kept = []
        for each, one, there in zip(found, people, inside, strict=True):
            detected = len(one.scores)
            self.report.beside += len(each.score) - detected
            near = each.select(there | (np.arange(len(there)) < detected))
            distinct = suppress_poses(near, settings.min_keypoint_confidence, settings.oks_nms)
            self.report.unsure += len(near.score) - len(distinct.score)
            best = np.sort(np.argsort(-distinct.score, kind="stable")[: self._most])
            self.report.cut += len(best) < len(distinct.score)
            chosen = distinct.select(best)
            if self._score_map is not None:
                chosen = replace(chosen, score=self._score_map.probability(chosen.score))
            self.report.empty += not len(best)
            kept.append(chosen)
        nobody = KeypointDetections.empty()
        if self._landmarks is not None:
            kept = self._landmarks.add_points(images, kept)
            points = self._landmarks.points
            nobody = nobody.add_points(
                points, np.empty((0, len(points), 2)), np.empty((0, len(points)))
            )
        rows = iter(kept)
        return [nobody if image is None else next(rows) for image, _ in batch]

    def _chunk(self, numbers: list[int], rows: list[KeypointDetections]) -> KeypointDetections:
        """Return the detections of frames in one record, padded with NaN."""
        arrays, each = {}, [found.arrays() for found in rows]
        for name, like in each[0].items():
            shape = (len(rows), self._most, *like.shape[1:])
            arrays[name] = np.full(shape, np.nan, dtype=np.float32)
            for row, found in zip(arrays[name], each, strict=True):
                row[: len(found[name])] = found[name]
        self.report.detections += sum(len(found.score) for found in rows)
        self.report.frames += len(rows)
        return rows[0].with_arrays(arrays, np.array(numbers, dtype=np.int64))


def _require_rgb(
    frames: Iterable[tuple[int, Image | None]], place: Place | None
) -> Iterator[tuple[int, Image | None]]:
    """Yield frames with images whose bytes are in order; refuse those that no net takes."""
    size = None if place is None else tuple(place.camera.image_size.tolist())
    for number, image in frames:
        if image is None:
            yield number, None
            continue
        size, given = size or image.shape[1::-1], (image.dtype, image.shape)
        if given != (np.dtype(np.uint8), (*size[::-1], 3)):
            raise InputError(
                f"image {number}",
                expected="uint8 RGB (height, width, 3) of {} x {} px, as the camera or the first "
                "image has it".format(*size),
                found=f"{image.dtype} {image.shape}",
                todo="Convert the images, for example with cv2.cvtColor and cv2.resize.",
            )
        yield number, np.ascontiguousarray(image)


def detect_people(
    images: Iterable[Image],
    settings: DetectionSettings = DetectionSettings(),  # noqa: B008
    *,
    detectors: Sequence[Detector] | None = None,
    camera: Camera | None = None,
    pitch: PitchTemplate | None = None,
) -> KeypointDetections:
    """Return the people in consecutive images of one camera.

    Args:
        images: (height, width, 3) RGB uint8 of one size, in order; read once.
        settings: detectors, pose net and thresholds. The defaults are the bundled nets.
        detectors: own detectors in place of those that the settings name; scores stay theirs.
        camera: calibrated camera, whose images are turned upright for the nets; with `pitch`,
            people beside the pitch are left out.
        pitch: pitch in the camera's view.

    Returns:
        Detections (frames, detections), with frame numbers from 0 on.

    Raises:
        InputError: a net or its file is missing or invalid, or an image has another form or size.
    """
    finder = PeopleFinder(
        load_detectors(settings) if detectors is None else detectors,
        load_pose(settings),
        settings,
        load_score_map(settings) if detectors is None else None,
        load_landmarks(settings),
    )
    place = None if camera is None else Place(camera, pitch)
    chunks = list(finder.find(enumerate(images), place))
    if not chunks:
        return KeypointDetections.from_keypoints(np.empty((0, 0, 17, 2)), np.empty((0, 0, 17)))
    most = max(int(np.isfinite(chunk.score).sum(axis=1).max()) for chunk in chunks)
    chunks = [chunk.select(slice(0, most)) for chunk in chunks]
    each = [chunk.arrays() for chunk in chunks]
    return chunks[0].with_arrays(
        {name: np.concatenate([one[name] for one in each]) for name in each[0]},
        np.concatenate([chunk.frame for chunk in chunks]),
    )


def find_poses(
    estimator: PoseEstimator,
    images: Sequence[Image],
    people: Sequence[People],
    settings: DetectionSettings,
) -> list[KeypointDetections]:
    """Return the poses of frames of one size, those of occluded people last.

    Boxes are those of the estimator, where it gives any.
    """
    boxes = [each.boxes for each in people]
    if isinstance(estimator, EstimatesFrames):
        seen = estimator.estimate_frames(images, boxes)
    else:
        seen = [estimator.estimate(*each) for each in zip(images, boxes, strict=True)]
    poses = [combine_boxes(*each) for each in zip(people, seen, strict=True)]
    if not (settings.find_occluded and isinstance(estimator, EstimatesFrames)):
        return poses
    occluded = estimator.find_occluded(images, [People.from_detections(each) for each in poses])
    return [KeypointDetections.concatenate(each) for each in zip(poses, occluded, strict=True)]
