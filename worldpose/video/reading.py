"""Frames of a video by number."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.video.frame_index import FrameIndex, index_frames


class VideoReader:
    """A video file with access to frames by number, forwards without seeking."""

    def __init__(self, path: Path, index: FrameIndex | None = None) -> None:
        """Open a file.

        Args:
            path: the video.
            index: of the video, if known; else it is computed.

        Raises:
            InputError: no video.
        """
        self.path = path
        self.index = index_frames(path) if index is None else index
        self._container = av.open(str(path))
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._number = {int(stamp): number for number, stamp in enumerate(self.index.stamps)}

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.index)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return one frame (height, width, 3) RGB.

        Raises:
            InputError: there is no such frame, or it cannot be decoded.
        """
        for _, picture in self.frames(number, number + 1):
            return picture
        raise self._damage_error(number)

    def frames(
        self, start: int = 0, stop: int | None = None, *, grey: bool = False
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield frame numbers from `start` up to before `stop`, each with its image.

        Args:
            start: first frame.
            stop: one past the last; the end of the video if None.
            grey: luma (height, width) as stored, in half the time, instead of RGB.

        Raises:
            InputError: there are no such frames, or one cannot be decoded.
        """
        for number, picture in self.readable(start, stop, grey=grey):
            if picture is None:
                raise self._damage_error(number)
            yield number, picture

    def readable(
        self,
        start: int = 0,
        stop: int | None = None,
        *,
        grey: bool = False,
        width: int | None = None,
    ) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        """Yield frames as `frames` does, with None for each damaged or undecodable one.

        Frames after a damaged one up to the next key frame are None too: they may be predicted from
        it.

        Args:
            start: first frame.
            stop: one past the last; the end of the video if None.
            grey: luma instead of RGB.
            width: RGB images get this width, before rotation [px]; None = unscaled.

        Raises:
            InputError: there are no such frames.
        """
        stop = len(self) if stop is None else stop
        if not 0 <= start <= stop <= len(self):
            raise InputError(
                str(self.path),
                expected=f"frames from 0 to {len(self)}",
                found=f"{start} to {stop}",
                todo="Ask for frames that the video has.",
            )
        wanted, sound_from = start, start
        for picture in self._shown_from(start) if start < stop else ():
            number = self._number.get(-1 if picture.pts is None else int(picture.pts), -1)
            if number < wanted:
                continue
            if number > wanted or picture.is_corrupt:
                sound_from = self._next_key(wanted)
            while wanted < min(number, stop):
                yield wanted, None
                wanted += 1
            if wanted < stop:
                yield wanted, _pixels(picture, grey, width) if wanted >= sound_from else None
                wanted += 1
            if wanted == stop:
                return
        for number in range(wanted, stop):
            yield number, None

    def _next_key(self, number: int) -> int:
        """Return the first frame after a damaged one that is not predicted from it."""
        keys = np.flatnonzero(self.index.key)
        after = int(np.searchsorted(keys, number, side="right"))
        return int(keys[after]) if after < len(keys) else len(self)

    def _shown_from(self, start: int) -> Iterator[av.VideoFrame]:
        """Yield displayed frames, from the last one up to `start` at which decoding can begin."""
        before = np.flatnonzero(self.index.key[: start + 1])
        begin = int(before[-1]) if len(before) else 0
        self._container.seek(
            int(self.index.stamps[begin]), stream=self._stream, backward=True, any_frame=False
        )
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:  # the file is truncated here
                packet = None
            if packet is None:
                return
            try:
                shown = packet.decode()
            except av.error.FFmpegError:
                continue  # its frames are missing; those after the next key frame are not
            for picture in shown:
                assert isinstance(picture, av.VideoFrame)  # of a video stream
                yield picture

    def _damage_error(self, number: int) -> InputError:
        return InputError(
            f"{self.path}: frame {number}",
            expected="a picture",
            found="one that cannot be decoded",
            todo="Convert the video with any video tool.",
        )


def _pixels(picture: av.VideoFrame, grey: bool, width: int | None) -> NDArray[np.uint8]:
    """Return the frame as displayed: RGB, or luma alone."""
    pixels = _stored_pixels(picture, grey, width)
    quarters = round(picture.rotation / 90.0) % 4  # counterclockwise, as in np.rot90
    return pixels if quarters == 0 else np.ascontiguousarray(np.rot90(pixels, quarters))


def _stored_pixels(picture: av.VideoFrame, grey: bool, width: int | None) -> NDArray[np.uint8]:
    """Return RGB, or the first plane of a planar format, without the padding of its rows."""
    if not grey and width is None:
        return np.asarray(picture.to_ndarray(format="rgb24"))
    if not grey and width is not None:
        height = round(picture.height * width / picture.width)
        small = picture.reformat(width, height, "rgb24", interpolation="AREA")
        return np.asarray(small.to_ndarray())
    if not picture.format.name.startswith(("yuv4", "yuvj4", "gray")):
        return np.asarray(picture.to_ndarray(format="gray"))
    plane = picture.planes[0]
    rows = np.frombuffer(bytes(plane), dtype=np.uint8).reshape(picture.height, plane.line_size)
    return np.ascontiguousarray(rows[:, : picture.width])
