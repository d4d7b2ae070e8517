"""Images by number, and the index of the frames of a video or of a folder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Self

import av
import numpy as np
from av.video.reformatter import ColorRange

from data_contracts.arrays import Flags, Floats, Image, Integers
from worldpose.errors import InputError

RATE_SLACK: Final = 0.1
"""Share of missing or duplicate frames from which a video's rate differs from its clock's."""

MAX_FRAME_PIXELS: Final = 100_000_000
"""Larger frames of videos are refused before they are decoded: one takes up to 0.8 GB."""


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """The frames of a video, in display order.

    A frame's number counts frames in display order, whatever rate the file states: containers round
    times, begin later than zero, and store frames in decoding order.

    Attributes:
        stamps: (pictures,) presentation time stamps, rising, in units of `time_base`.
        key: (pictures,) whether decoding can begin there.
        time_base: seconds per unit; None where stamps are frame numbers, as in a folder of images.
        size: width, height of the frames as displayed, after rotation [px].
        is_counted: whether a frame is known only by counting all frames before it: the file does
            not say when each one is shown, as AVI with B-frames of H.264.
    """

    stamps: Integers
    key: Flags
    time_base: Fraction | None
    size: tuple[int, int]
    is_counted: bool = False

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def times(self) -> Floats:
        """Return the display times of frames since the first (pictures,) [s]; NaN if unknown."""
        unit = np.nan if self.time_base is None else float(self.time_base)
        return np.asarray((self.stamps - self.stamps[0]) * unit)

    @property
    def fps(self) -> float:
        """Return frames per second, from the median step between frames; NaN if unknown."""
        if len(self) < 2 or self.time_base is None:
            return float("nan")
        # The median of the single steps is rounded to the time base; the whole length is not.
        step = np.diff(self.stamps)
        away = np.abs(step - np.median(step))
        # Rounding moves a step by one unit; of AVI, two in place of one are a lost frame, as its
        # unit is the time of a frame and not of a clock.
        is_rounded = np.median(step) > 1.0 or self.time_base < 0.002
        usual = away <= max(float(is_rounded), float(away.min()))
        return float(1.0 / (step[usual].mean() * float(self.time_base)))

    def on_clock(self, fps: float, where: str) -> Integers:
        """Return the number of the video frame for each clock frame (frames,); -1 if missing.

        Frame n is shown n / fps after the first one. A frame that a recorder dropped, or a pause,
        leaves its clock frames empty and shifts no later one; of two video frames for one clock
        frame the nearer counts. InputError if the video has another rate or none, or too many
        frames.
        """
        most = 10_000_000  # two days at 60 frames/s: one wrong stamp would fill memory
        if self.time_base is None:
            exact = (self.stamps - self.stamps[0]).astype(np.float64)
        else:
            exact = self.times * fps
        if exact[-1] >= most:
            raise InputError(
                where,
                expected=f"pictures within {most} frames, as numbers and time stamps say",
                found=f"the last one {exact[-1]:.0f} frames after the first",
                todo="Correct the numbers of the images, or write the video again.",
            )
        slot = np.rint(exact).astype(np.int64)
        late = np.abs(exact - slot)
        # By clock frame, then by falling distance, so that the nearest one stays.
        order = np.lexsort((-late, slot))
        picture = np.full(slot[-1] + 1, -1, dtype=np.int64)
        picture[slot[order]] = order
        filled = int(np.count_nonzero(picture >= 0))
        odd = (len(picture) - filled) + (len(slot) - filled) - _count_dropped(np.diff(exact))
        if self.time_base is not None and odd > RATE_SLACK * max(len(picture), len(slot)):
            raise self._rate_error(fps, where)
        return picture

    def shown(self, number: Integers, fps: float, where: str) -> Integers:
        """Return the video frame (n,) at numbers (n,) of `on_clock`; -1 if missing or beyond."""
        clock = self.on_clock(fps, where)
        inside = (number >= 0) & (number < len(clock))
        return np.where(inside, clock[np.where(inside, number, 0)], -1)

    def _rate_error(self, fps: float, where: str) -> InputError:
        """Return the error of a video that does not follow a clock."""
        step = np.diff(self.times)
        if abs(self.fps - fps) > RATE_SLACK * fps:
            return InputError(
                where,
                expected=f"{fps:g} frames per second, the rate of the match",
                found=f"{self.fps:.4g}",
                todo="Convert the video to that rate, or correct the rate: --fps of an import, fps "
                "in match.yaml, where a camera may have its own.",
            )
        return InputError(
            where,
            expected=f"{fps:g} frames per second throughout",
            found=f"a rate that varies: images are {step.min():.4g} to {step.max():.4g} s apart, "
            f"most of all after image {step.argmax()} at {self.times[step.argmax()]:.2f} s",
            todo="Convert the video to a constant frame rate with any video tool.",
        )


def _count_dropped(steps: Floats) -> int:
    """Return how many frames a recorder of the clock's rate left out, by images' steps [frame]."""
    if not len(steps) or abs(float(np.median(steps)) - 1.0) > RATE_SLACK:
        return 0
    whole = np.rint(steps)
    # A pause may end between two frames of the clock; a slower rate has short steps between them.
    is_gap = (whole >= 2) & ((np.abs(steps - whole) < RATE_SLACK) | (steps > 4.5))
    return int((whole[is_gap] - 1).sum())


class Pictures(ABC):
    """Images by number: those of a video, or of a folder."""

    index: FrameIndex

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.index)

    def close(self) -> None:  # noqa: B027
        """Close what is open: of a folder, nothing."""

    def frame(self, number: int) -> Image:
        """Return one frame (height, width, 3) RGB; InputError if there is none that decodes."""
        for _, picture in self.frames(number, number + 1):
            return picture
        raise self.damage_error(number)

    def frames(
        self, start: int = 0, stop: int | None = None, *, grey: bool = False
    ) -> Iterator[tuple[int, Image]]:
        """Yield frame numbers from `start` up to before `stop`, or the end, each with its image.

        Grey is luma (height, width) as stored, in half the time, instead of RGB. InputError if
        there are no such frames, or one cannot be decoded.
        """
        for number, picture in self.readable(start, stop, grey=grey):
            if picture is None:
                raise self.damage_error(number)
            yield number, picture

    @abstractmethod
    def readable(
        self,
        start: int = 0,
        stop: int | None = None,
        *,
        grey: bool = False,
        only: Collection[int] | None = None,
    ) -> Iterator[tuple[int, Image | None]]:
        """Yield frames as `frames` does, with None for each that cannot be decoded."""

    @abstractmethod
    def damage_error(self, number: int) -> InputError:
        """Return the error of a frame that cannot be decoded."""


def convert_pixels(picture: av.VideoFrame, grey: bool, width: int | None) -> Image:
    """Return the frame as displayed: RGB, or luma alone."""
    pixels = _stored_pixels(picture, grey, width)
    quarters = round(picture.rotation / 90.0) % 4  # counterclockwise, as in np.rot90
    return pixels if quarters == 0 else np.ascontiguousarray(np.rot90(pixels, quarters))


def _stored_pixels(picture: av.VideoFrame, grey: bool, width: int | None) -> Image:
    """Return RGB, or luma of 8 bits as stored, without the padding of its rows."""
    if not grey and width is None:
        return np.asarray(picture.to_ndarray(format="rgb24"))
    if not grey and width is not None:
        height = round(picture.height * width / picture.width)
        small = picture.reformat(width, height, "rgb24", interpolation="AREA")
        return np.asarray(small.to_ndarray())
    form = picture.format
    if not form.name.startswith(("yuv4", "yuvj4", "gray")) or form.components[0].bits != 8:
        # One range for both: luma stays as stored, as in the plane below.
        small = picture.reformat(
            format="gray", src_color_range=ColorRange.JPEG, dst_color_range=ColorRange.JPEG
        )
        return np.asarray(small.to_ndarray())
    plane = picture.planes[0]
    rows = np.frombuffer(bytes(plane), dtype=np.uint8).reshape(picture.height, plane.line_size)
    return np.ascontiguousarray(rows[:, : picture.width])
