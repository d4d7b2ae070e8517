"""Clocks of the cameras: which frame of a camera shows a match frame, and how much it is off.

A camera's `offset_frames` o(f) says that match frame f is its frame

    n(f) = f r + o(f),

with the ratio r of its frame rate and the match's. It is a number, or rising pairs [match frame,
offset] with linear change between them: a clock that drifts. It is constant before the first
pair and after the last; two pairs at neighbouring frames are a step, of frames that a recorder lost
or repeated. The nearest whole frame is read; the rest is corrected in the people's 2D poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.match import ClockOffset
from worldpose.errors import InputError


def row_rate(where: str, fps: float, frame: Integers | None = None) -> float:
    """Return the rows per second of rows with these frame numbers (n,), `fps` numbers a second.

    Without numbers, a row is a frame. InputError for another `fps`, or frames in unequal steps.
    """
    if not isinstance(fps, int | float | np.number) or not 0.0 < fps < np.inf:
        todo = "Give the frame rate of the recording, such as 25.0."
        raise InputError(f"{where}: fps", "frames per second, above 0", repr(fps), todo)
    steps = np.unique(np.diff([] if frame is None else frame))
    if len(steps) > 1 or (len(steps) and steps[0] < 1):
        expected = "frame numbers that rise in equal steps"
        todo = "Add the frames in which nobody was seen (`KeypointDetections.reindex`)."
        raise InputError(f"{where}: frame", expected, f"steps from {steps[0]} to {steps[-1]}", todo)
    return float(fps) / float(steps[0]) if len(steps) else float(fps)


def exact_frames(frame: Integers, offset: ClockOffset, rate: float = 1.0) -> Floats:
    """Return the exact frames (n,) of a camera, `rate` per match frame, at match frames (n,)."""
    if not isinstance(offset, Sequence):
        return np.asarray(frame * rate + offset, dtype=np.float64)
    at, there = np.array(offset, dtype=np.float64).T
    return np.asarray(frame * rate + np.interp(frame, at, there))


def offset_change(late: Floats | float, rate: Floats | float) -> Floats:
    """Return what to add to `offset_frames` if images are `late` [match frame]: [camera frame].

    Camera frame n(f) shows f + late, and so match frame f is n(f - late) = f r + o - late r.
    """
    return np.asarray(-late * rate)


def simplest_offset(frame: Integers, exact: Floats) -> ClockOffset:
    """Return the `offset_frames` with these values (n,) at rising match frames (n,).

    A clock that only steps has whole offsets: a recorder loses and repeats whole frames.
    """
    gap = np.diff(frame)
    slopes = np.abs(np.diff(exact)) / np.maximum(gap, 1)
    drifts = bool(((slopes > 1e-6) & (gap > 1)).any())
    value = np.round(exact, 2) if drifts else np.floor(exact + 0.5)
    if not drifts and (value == value[0]).all():
        return int(value[0])
    pairs = [(int(a), float(b)) for a, b in zip(frame, value, strict=True)]
    if drifts:
        return tuple(pairs)
    ends = [each for step in pairwise(pairs) if step[0][1] != step[1][1] for each in step]
    return tuple(dict.fromkeys(ends))


def camera_frames(frame: Integers, offset: ClockOffset, rate: float = 1.0) -> Integers:
    """Return the nearest camera frame (n,) of each match frame; arguments of `exact_frames`."""
    return np.floor(exact_frames(frame, offset, rate) + 0.5).astype(np.int64)


def remaining_offset(frame: Integers, offset: ClockOffset, rate: float = 1.0) -> Floats:
    """Return how much later than the match frames (n,) their camera frames are [match frame]."""
    exact = exact_frames(frame, offset, rate)
    return np.asarray((np.floor(exact + 0.5) - exact) / rate)


def rows_at(values: Floats, row: Floats) -> Floats:
    """Return values (frames, ...) at fractional rows (n,), linear in between; NaN beyond ends."""
    row = np.where(np.isnan(row), -2.0, row)
    before = np.floor(row).astype(np.int64)
    share = (row - before).reshape(-1, *(1,) * (values.ndim - 1))

    def take(rows: Integers) -> Floats:
        out = np.full((len(rows), *values.shape[1:]), np.nan)
        inside = (rows >= 0) & (rows < len(values))
        out[inside] = values[rows[inside]]
        return out

    if not share.any():
        return take(before)
    between = (1.0 - share) * take(before) + share * take(before + 1)
    return np.where(share == 0.0, take(before), between)


@dataclass(frozen=True, eq=False)
class ImageClock:
    """The images of a moving camera at match frames.

    Attributes:
        number: (frames,) number in the video of the image that is nearest to each match frame.
        late: (frames,) how much later than the match frames these images are [match frame].
        rate: images per match frame.
    """

    number: Integers
    late: Floats
    rate: float

    @classmethod
    def of(cls, frame: Integers, offset: ClockOffset, rate: float, start: float) -> ImageClock:
        """Return the clock of a clip with consecutive match frames (frames,), from image `start`.

        `rate` is in images per match frame, and `offset` as of
        `worldpose.ingest.footage.UnitFrames`.
        """
        number = camera_frames(frame, offset, rate)
        return cls(number, (number - start) / rate - (frame - frame[0]), rate)

    def __getitem__(self, frames: slice) -> ImageClock:
        """Return the clock of some of the match frames."""
        return ImageClock(self.number[frames], self.late[frames], self.rate)

    @property
    def images(self) -> Integers:
        """Numbers (images,) of all images from the first to the last."""
        return np.arange(self.number[0], self.number[-1] + 1)

    @property
    def image_row(self) -> Integers:
        """(frames,), place of each match frame's image in `images`."""
        return np.asarray(self.number - self.number[0])

    @property
    def frame_row(self) -> Floats:
        """(images,), place of each of `images` among the match frames, fractional."""
        return np.asarray(self.late[0] + np.arange(len(self.images)) / self.rate)

    def frame_of(self, number: Integers | int) -> Integers:
        """Return the place of the last match frame that images of these numbers do not precede."""
        after = np.searchsorted(self.number, number, side="right")
        return np.asarray(np.maximum(after - 1, 0), dtype=np.int64)

    def to_images(self, values: Floats, late: float = 0.0) -> Floats:
        """Return values (frames, ...) at the times of each frame's image and `late` frames on."""
        return rows_at(values, np.arange(len(values)) + self.late + late)

    def to_frames(self, values: Floats, late: float = 0.0, *, whole: bool = False) -> Floats:
        """Return values (frames, ...) of images, `late` frames later than stated, at the frames.

        They are linear between two images, or `whole` those of the nearest one.
        """
        frame = np.arange(len(values))
        _, row = np.unique(self.number, return_index=True)
        time = (frame + self.late + late)[row]
        times = [time[0] - 1.0 / self.rate, *time, time[-1] + 1.0 / self.rate]
        places = np.arange(-1.0, len(row) + 1.0)
        at = np.interp(frame, times, places, left=np.nan, right=np.nan)
        return rows_at(values[row], np.floor(at + 0.5) if whole else at)
