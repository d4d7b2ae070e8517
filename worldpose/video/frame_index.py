"""Which picture of a video file is frame n: the time stamps of all its pictures in order."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """The pictures of a video file, in the order in which they are shown.

    A frame number counts pictures as shown, whatever the file says of its rate: containers round
    times, begin later than zero, and store pictures in the order of decoding.

    Attributes:
        stamps: (frames,) presentation time stamps, rising, in units of `time_base`.
        key: (frames,) whether decoding can begin there.
        time_base: seconds a unit.
        size: width, height [px].
    """

    stamps: NDArray[np.int64]
    key: NDArray[np.bool_]
    time_base: Fraction
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def times(self) -> NDArray[np.float64]:
        """When each frame is shown, from the first one on (frames,) [s]."""
        return np.asarray((self.stamps - self.stamps[0]) * float(self.time_base))

    @property
    def fps(self) -> float:
        """Frames a second, from the median time between neighbours; NaN for a single frame."""
        if len(self) < 2:
            return float("nan")
        # The median of the single steps is rounded to the time base; the whole length is not.
        step = np.diff(self.stamps)
        usual = np.abs(step - np.median(step)) <= 1
        return float(1.0 / (step[usual].mean() * float(self.time_base)))


def index_frames(path: Path) -> FrameIndex:
    """Return the index of a file's first video stream, from its packets: nothing is decoded.

    Raises:
        InputError: no video, or pictures without time stamps.
    """
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise _no_video(path, "no video stream")
            stream = container.streams.video[0]
            packets = [
                (packet.pts, packet.is_keyframe)
                for packet in container.demux(stream)
                if packet.size and not packet.is_discard
            ]
            base, size = stream.time_base, (stream.width, stream.height)
    except (av.error.FFmpegError, OSError) as error:
        raise _no_video(path, f"{error}") from error
    if not packets or base is None or any(stamp is None for stamp, _ in packets):
        raise _no_video(path, f"{len(packets)} pictures, not all with time stamps")
    stamps = np.array([stamp for stamp, _ in packets], dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    key = np.array([key for _, key in packets], dtype=np.bool_)[order]
    return FrameIndex(stamps[order], key, base, size)


def _no_video(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="a video file with time stamps",
        found=found,
        todo="Give an mp4, mov or mkv file; write others anew with any video tool.",
    )
