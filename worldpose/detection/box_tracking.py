"""2D tracking of the boxes of one camera (ByteTrack, Zhang et al. 2022)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats, Image, Integers
from worldpose.detection.interfaces import People
from worldpose.detection.settings import DetectionSettings
from worldpose.geometry.boxes import box_iou

PLACE_NOISE: Final = 1.0 / 20.0
"""Standard deviation of a box's position and size, over its height [1]; ByteTrack's."""
SPEED_NOISE: Final = 1.0 / 160.0
"""Standard deviation of their change per frame, over the height [1/frame]; ByteTrack's."""

_STEP = np.eye(8) + np.eye(8, k=4)
"""Transition matrix: speeds move positions."""


class BoxTracker:
    """Tracks of one camera.

    A Kalman filter per track estimates the centre, width and height of its box and their change per
    frame. High-score boxes are assigned to tracks first. Low-score boxes only continue unmatched
    tracks that were seen in the previous frame, and they begin none: a partly occluded person keeps
    the track, and a flickering box in the crowd does not become one.
    """

    def __init__(self, high_score_threshold: float, track_buffer_frames: int) -> None:
        """Begin without tracks, which boxes of a high score may begin, and unseen frames end."""
        self._high_score = high_score_threshold
        self._buffer = track_buffer_frames
        self._mean: Floats = np.empty((0, 8))
        self._covariance: Floats = np.empty((0, 8, 8))
        self._id: Integers = np.empty(0, dtype=np.int64)
        self._unseen: Integers = np.empty(0, dtype=np.int64)
        self._next = 0

    def update(self, boxes: Floats, scores: Floats, frames: int = 1) -> Integers:
        """Return the track of each box (boxes,), -1 for low-score boxes that continue none.

        Boxes (boxes, 4) x0, y0, x1, y1 [px] with scores (boxes,) are those of the next frame in
        which people were detected, `frames` after the previous call's.
        """
        for _ in range(frames):
            self._predict()
        self._unseen += frames
        track = np.full(len(boxes), -1, dtype=np.int64)
        seen = np.zeros(len(self._id), dtype=np.bool_)
        middle, half = self._mean[:, :2], np.maximum(self._mean[:, 2:4], 1.0) / 2.0
        expected = np.hstack([middle - half, middle + half])
        sure = scores >= self._high_score
        for candidates, tracks, least in (
            # A high-score box continues a track whose predicted box it overlaps more [1]: a small
            # box moves by half of its width per frame.
            (np.flatnonzero(sure), np.ones_like(seen), 0.2),
            # A low-score box must lie near the prediction.
            (np.flatnonzero(~sure), self._unseen == frames, 0.5),
        ):
            rows = np.flatnonzero(tracks & ~seen)
            for row, box in _assign_boxes(expected[rows], boxes[candidates], least):
                track[candidates[box]] = rows[row]
                seen[rows[row]] = True
        matched = track >= 0
        self._update(track[matched], boxes[matched])
        ids = np.where(matched, self._id[track] if len(self._id) else -1, -1)
        self._unseen[seen] = 0
        self._drop_old_tracks()
        new = np.flatnonzero(sure & ~matched)
        ids[new] = self._begin(boxes[new])
        return np.asarray(ids, dtype=np.int64)

    def _predict(self) -> None:
        self._mean = self._mean @ _STEP.T
        scale = np.repeat([PLACE_NOISE, SPEED_NOISE], 4) * np.maximum(self._mean[:, 3:4], 1.0)
        noise = np.asarray(np.eye(8) * (scale**2)[:, None, :])
        self._covariance = _STEP @ self._covariance @ _STEP.T + noise

    def _update(self, rows: Integers, boxes: Floats) -> None:
        mean, covariance = self._mean[rows], self._covariance[rows]
        spread = np.eye(4) * (PLACE_NOISE * np.maximum(mean[:, 3], 1.0))[:, None, None] ** 2
        gain = covariance[:, :, :4] @ np.linalg.inv(covariance[:, :4, :4] + spread)
        residual = _as_states(boxes) - mean[:, :4]
        self._mean[rows] = mean + (gain @ residual[..., None])[..., 0]
        self._covariance[rows] = covariance - gain @ covariance[:, :4, :]

    def _drop_old_tracks(self) -> None:
        kept = self._unseen <= self._buffer
        self._mean, self._covariance = self._mean[kept], self._covariance[kept]
        self._id, self._unseen = self._id[kept], self._unseen[kept]

    def _begin(self, boxes: Floats) -> Integers:
        states = _as_states(boxes)
        ids = self._next + np.arange(len(boxes))
        self._next += len(boxes)
        scale = np.repeat([2.0 * PLACE_NOISE, 10.0 * SPEED_NOISE], 4) * states[:, 3:4]
        self._mean = np.vstack([self._mean, np.hstack([states, np.zeros_like(states)])])
        self._covariance = np.concatenate([self._covariance, np.eye(8) * (scale**2)[:, None, :]])
        self._id = np.append(self._id, ids)
        self._unseen = np.append(self._unseen, np.zeros(len(boxes), dtype=np.int64))
        return ids


def _assign_boxes(expected: Floats, boxes: Floats, least: float) -> list[tuple[int, int]]:
    """Return pairs of rows that overlap by more than `least`, with the largest total overlap."""
    shared = box_iou(expected, boxes)
    # A forbidden pair has value 0, so that it never displaces an allowed one.
    pairs = linear_sum_assignment(-np.where(shared > least, shared, 0.0))
    return [(int(a), int(b)) for a, b in zip(*pairs, strict=True) if shared[a, b] > least]


def _as_states(boxes: Floats) -> Floats:
    """Return the centre x, y, width, height of boxes (n, 4)."""
    size = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    return np.hstack([(boxes[:, :2] + boxes[:, 2:]) / 2.0, size])


@dataclass
class _BufferedFrame:
    """A buffered frame whose gaps may still be filled; `searched` frames lie up to it."""

    number: int
    image: Image | None
    searched: int = 0
    boxes: dict[int, tuple[Floats, float]] = field(default_factory=dict)


@dataclass
class _BoxTrack:
    """Last frame, box and score of a track, and its number of sightings."""

    number: int
    box: Floats
    score: float
    sightings: int = 1


class BoxCleaner:
    """Cleans detections frame by frame, in bounded memory."""

    def __init__(self, settings: DetectionSettings) -> None:
        self._settings = settings
        self._tracker = BoxTracker(settings.high_score_threshold, settings.track_buffer_frames)
        self._held: deque[_BufferedFrame] = deque()
        self._tracks: dict[int, _BoxTrack] = {}
        self._searched = 0
        self._last: int | None = None
        self.bridged = self.flickers = 0

    def clean(
        self, frames: Iterable[tuple[int, Image | None, People | None]]
    ) -> Iterator[tuple[int, Image | None, People]]:
        """Yield each frame with the people in it, of frames with None where no detector ran."""
        gap, later = self._settings.longest_gap, self._settings.min_hits - 1
        for number, image, people in frames:
            self._held.append(_BufferedFrame(number, image))
            if people is not None:
                self._add_detections(number, people, gap)
            self._held[-1].searched = self._searched
            # A frame is held until a track that begins there can have all of its sightings.
            while (
                self._held
                and number - self._held[0].number >= gap
                and self._searched - self._held[0].searched >= later
            ):
                yield self._release_frame()
        while self._held:
            yield self._release_frame()

    def _add_detections(self, number: int, people: People, gap: int) -> None:
        later = 1 if self._last is None else number - self._last
        self._last = number
        self._searched += 1
        ids = self._tracker.update(people.boxes, people.scores, later)
        for track, box, score in zip(ids, people.boxes, people.scores, strict=True):
            if track < 0:
                continue
            self._held[-1].boxes[int(track)] = box, float(score)
            before = self._tracks.get(int(track))
            if before is None:
                self._tracks[int(track)] = _BoxTrack(number, box, float(score))
                continue
            if 1 < number - before.number <= gap:
                self._fill(int(track), before, number, box, float(score))
            before.number, before.box, before.score = number, box, float(score)
            before.sightings += 1

    def _fill(self, track: int, before: _BoxTrack, number: int, box: Floats, score: float) -> None:
        """Interpolate boxes linearly between two sightings of a track."""
        for held in self._held:
            if before.number < held.number < number and held.image is not None:
                part = (held.number - before.number) / (number - before.number)
                between = (1.0 - part) * before.box + part * box
                held.boxes[track] = between, (1.0 - part) * before.score + part * score
                self.bridged += 1

    def _release_frame(self) -> tuple[int, Image | None, People]:
        held = self._held.popleft()
        least = min(self._settings.min_hits, self._searched)
        kept = {
            track: box
            for track, box in sorted(held.boxes.items())
            if self._tracks[track].sightings >= least
        }
        self.flickers += len(held.boxes) - len(kept)
        gone = [
            track
            for track, last in self._tracks.items()
            if held.number - last.number > self._settings.track_buffer_frames
        ]
        for track in gone:
            del self._tracks[track]
        boxes = [box for box, _ in kept.values()]
        people = People(np.array(boxes).reshape(-1, 4), np.array([s for _, s in kept.values()]))
        return held.number, held.image, people


def detect_strided(
    frames: Iterable[tuple[int, Image | None]],
    detect: Callable[[list[Image]], list[People]],
    settings: DetectionSettings,
) -> Iterator[tuple[int, Image | None, People | None]]:
    """Yield each frame with its detections; detectors run on every `stride`-th and the last one.

    In place of one without an image, they run on the next one, and on the one before where the
    tracks could not be filled from run to run. Numbers rise; `detect` takes images of one size.
    """
    waiting: list[tuple[int, Image | None]] = []
    chosen: list[int] = []
    searched: int | None = None

    def choose_last_image() -> None:
        last = next((k for k in reversed(range(len(waiting))) if waiting[k][1] is not None), None)
        if last is not None and last not in chosen:
            chosen.append(last)

    def iterate_found() -> Iterator[tuple[int, Image | None, People | None]]:
        images = [image for at in chosen if (image := waiting[at][1]) is not None]
        people = dict(zip(chosen, detect(images) if images else [], strict=True))
        for at, (number, image) in enumerate(waiting):
            yield number, image, people.get(at)
        waiting.clear()
        chosen.clear()

    for number, image in frames:
        if image is None or (searched is not None and number < searched + settings.stride):
            waiting.append((number, image))
            continue
        if searched is not None and number - searched > settings.longest_gap:
            choose_last_image()
            if len(chosen) == settings.batch:
                yield from iterate_found()
        waiting.append((number, image))
        choose_last_image()
        searched = number
        # 32 frames of 4K take 0.8 GB.
        if len(chosen) == settings.batch or len(waiting) >= max(settings.batch, 32):
            yield from iterate_found()
    choose_last_image()  # so that boxes reach the last frame
    yield from iterate_found()
