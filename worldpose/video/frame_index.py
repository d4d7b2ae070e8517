"""Time stamps of all frames of a video in display order."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from worldpose.errors import InputError

MOST_FRAMES: Final = 10_000_000
"""Most frames of a video's clock, two days at 60 frames/s: one wrong stamp would fill memory."""
RATE_SLACK: Final = 0.1
"""Share of missing or duplicate frames from which a video's rate differs from its clock's."""


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
    """

    stamps: NDArray[np.int64]
    key: NDArray[np.bool_]
    time_base: Fraction | None
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def times(self) -> NDArray[np.float64]:
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
        usual = np.abs(step - np.median(step)) <= 1
        return float(1.0 / (step[usual].mean() * float(self.time_base)))

    def on_clock(self, fps: float, where: str) -> NDArray[np.int64]:
        """Return the number of the video frame for each clock frame (frames,); -1 if missing.

        Frame n is shown n / fps after the first one. A frame that a recorder dropped leaves its
        clock frame empty and shifts no later one; of two video frames for one clock frame the
        nearer counts.

        Args:
            fps: frames per second of the clock.
            where: the video, for messages.

        Raises:
            InputError: the video has another rate, or implausibly many frames.
        """
        if self.time_base is None:
            exact = (self.stamps - self.stamps[0]).astype(np.float64)
        else:
            exact = self.times * fps
        if exact[-1] >= MOST_FRAMES:
            raise InputError(
                where,
                expected=f"pictures within {MOST_FRAMES} frames, as numbers and time stamps say",
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
        odd = (len(picture) - filled) + (len(slot) - filled)
        if self.time_base is not None and odd > RATE_SLACK * max(len(picture), len(slot)):
            raise InputError(
                where,
                expected=f"{fps:g} frames per second, the rate in match.yaml",
                found=f"{self.fps:.4g}",
                todo="Correct fps in match.yaml, or convert the video to that rate.",
            )
        return picture


def index_frames(path: Path) -> FrameIndex:
    """Return the index of a file's first video stream, from its packets: it decodes one frame.

    Raises:
        InputError: no video, or frames without time stamps.
    """
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise _no_video(path, "no video stream")
            stream = container.streams.video[0]
            size = _shown_size(container, stream)
            container.seek(0)
            packets = [
                (packet.pts, packet.is_keyframe)
                for packet in _packets(container, stream)
                if packet.size and not packet.is_discard
            ]
            base = stream.time_base
    except (av.error.FFmpegError, OSError) as error:
        raise _no_video(path, f"{error}") from error
    if not packets or base is None or any(stamp is None for stamp, _ in packets):
        raise _no_video(path, f"{len(packets)} pictures, not all with time stamps")
    stamps = np.array([stamp for stamp, _ in packets], dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    key = np.array([key for _, key in packets], dtype=np.bool_)[order]
    return FrameIndex(stamps[order], key, base, size)


def _packets(container: InputContainer, stream: VideoStream) -> list[av.Packet[VideoStream]]:
    """Return all packets of a stream; a truncated file ends where it was cut."""
    found: list[av.Packet[VideoStream]] = []
    try:
        found.extend(container.demux(stream))
    except av.error.FFmpegError:
        if not found:
            raise
    return found


def _shown_size(container: InputContainer, stream: VideoStream) -> tuple[int, int]:
    """Return width and height as displayed: an upright camera stores rotated frames."""
    for picture in container.decode(stream):
        if picture.rotation % 180:
            return picture.height, picture.width
        return picture.width, picture.height
    return stream.width, stream.height


def _no_video(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="a video file with time stamps",
        found=found,
        todo="Give an mp4, mov or mkv file; convert others with any video tool.",
    )
