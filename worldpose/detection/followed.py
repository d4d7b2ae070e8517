"""People's boxes in every frame, without flickers, with short gaps filled, at a short delay."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.detection.byte_track import BoxTracker
from worldpose.detection.interfaces import People
from worldpose.detection.settings import DetectionSettings


@dataclass
class _Held:
    """A buffered frame whose gaps may still be filled."""

    number: int
    picture: Image | None
    boxes: dict[int, tuple[Floats, float]] = field(default_factory=dict)


@dataclass
class _Track:
    """Last frame, box and score of a track, and its number of sightings."""

    number: int
    box: Floats
    score: float
    sightings: int = 1


class Follower:
    """Cleans detections frame by frame, in bounded memory (D3)."""

    def __init__(self, settings: DetectionSettings) -> None:
        self._settings = settings
        self._tracker = BoxTracker(settings.high_score_threshold, settings.track_buffer_frames)
        self._held: deque[_Held] = deque()
        self._tracks: dict[int, _Track] = {}
        self._looks = 0
        self._last: int | None = None
        self.bridged = self.flickers = 0

    def follow(
        self, frames: Iterable[tuple[int, Image | None, People | None]]
    ) -> Iterator[tuple[int, Image | None, People]]:
        """Yield each frame with the people in it.

        Args:
            frames: rising numbers, images, and detections; None where no detector ran.
        """
        settings = self._settings
        lag = max(settings.max_gap_frames, settings.stride)
        for number, picture, people in frames:
            self._held.append(_Held(number, picture))
            if people is not None:
                self._look(number, people, lag)
            while self._held and number - self._held[0].number >= lag:
                yield self._released()
        while self._held:
            yield self._released()

    def _look(self, number: int, people: People, lag: int) -> None:
        later = 1 if self._last is None else number - self._last
        self._last = number
        self._looks += 1
        ids = self._tracker.follow(people.boxes, people.scores, later)
        for track, box, score in zip(ids, people.boxes, people.scores, strict=True):
            if track < 0:
                continue
            self._held[-1].boxes[int(track)] = box, float(score)
            before = self._tracks.get(int(track))
            if before is None:
                self._tracks[int(track)] = _Track(number, box, float(score))
                continue
            if 1 < number - before.number <= lag:
                self._fill(int(track), before, number, box, float(score))
            before.number, before.box, before.score = number, box, float(score)
            before.sightings += 1

    def _fill(self, track: int, before: _Track, number: int, box: Floats, score: float) -> None:
        """Interpolate boxes linearly between two sightings of a track."""
        for held in self._held:
            if before.number < held.number < number and held.picture is not None:
                part = (held.number - before.number) / (number - before.number)
                between = (1.0 - part) * before.box + part * box
                held.boxes[track] = between, (1.0 - part) * before.score + part * score
                self.bridged += 1

    def _released(self) -> tuple[int, Image | None, People]:
        held = self._held.popleft()
        least = min(self._settings.min_hits, self._looks)
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
        return held.number, held.picture, people


def looked_at(
    frames: Iterable[tuple[int, Image | None]],
    look: Callable[[list[Image]], list[People]],
    stride: int,
    batch: int,
) -> Iterator[tuple[int, Image | None, People | None]]:
    """Yield each frame with its detections; detectors run on every `stride`-th and the last one.

    Args:
        frames: rising numbers with images; None where there is none.
        look: detects people in images of one size.
        stride: frames between runs of the detector.
        batch: images per call of the detector.
    """
    waiting: list[tuple[int, Image | None]] = []
    chosen: list[int] = []
    due: int | None = None

    def found() -> Iterator[tuple[int, Image | None, People | None]]:
        pictures = [picture for at in chosen if (picture := waiting[at][1]) is not None]
        people = dict(zip(chosen, look(pictures) if pictures else [], strict=True))
        for at, (number, picture) in enumerate(waiting):
            yield number, picture, people.get(at)
        waiting.clear()
        chosen.clear()

    for number, picture in frames:
        waiting.append((number, picture))
        if picture is not None and (due is None or number >= due):
            chosen.append(len(waiting) - 1)
            due = number + stride
        if len(chosen) == batch:
            yield from found()
    last = next((at for at in reversed(range(len(waiting))) if waiting[at][1] is not None), None)
    if last is not None and last not in chosen:
        chosen.append(last)  # so that boxes reach the last frame
    yield from found()
