"""Pictures of a video by frame number."""

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
    """A video file whose frames are read by number, forwards without seeking."""

    def __init__(self, path: Path, index: FrameIndex | None = None) -> None:
        """Open a file.

        Args:
            path: the video.
            index: of it, where it is known; else it is made.

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
        """Return one picture (height, width, 3) RGB.

        Raises:
            InputError: there is no such frame, or it cannot be decoded.
        """
        for _, picture in self.frames(number, number + 1):
            return picture
        raise self._broken(number)

    def frames(
        self, start: int = 0, stop: int | None = None, *, grey: bool = False
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield frame numbers from `start` up to before `stop`, each with its picture.

        Args:
            start: first frame.
            stop: one past the last; the end of the video if None.
            grey: luma (height, width) as it is stored, in half the time, instead of RGB.

        Raises:
            InputError: there are no such frames, or one cannot be decoded.
        """
        stop = len(self) if stop is None else stop
        if not 0 <= start <= stop <= len(self):
            raise InputError(
                str(self.path),
                expected=f"frames from 0 to {len(self)}",
                found=f"{start} to {stop}",
                todo="Ask for frames that the video has.",
            )
        if start == stop:
            return
        before = np.flatnonzero(self.index.key[: start + 1])
        begin = int(before[-1]) if len(before) else 0
        self._container.seek(
            int(self.index.stamps[begin]), stream=self._stream, backward=True, any_frame=False
        )
        wanted = start
        try:
            for picture in self._container.decode(self._stream):
                number = self._number.get(-1 if picture.pts is None else int(picture.pts), -1)
                if number < wanted:
                    continue
                if number > wanted:
                    break
                yield number, _pixels(picture, grey)
                wanted += 1
                if wanted == stop:
                    return
        except av.error.FFmpegError as error:
            raise self._broken(wanted) from error
        raise self._broken(wanted)

    def _broken(self, number: int) -> InputError:
        return InputError(
            f"{self.path}: frame {number}",
            expected="a picture",
            found="one that cannot be decoded",
            todo="Write the video anew with any video tool.",
        )


def _pixels(picture: av.VideoFrame, grey: bool) -> NDArray[np.uint8]:
    """Return RGB, or the first plane of a planar format, without the padding of its rows."""
    if not grey:
        return np.asarray(picture.to_ndarray(format="rgb24"))
    if not picture.format.name.startswith(("yuv4", "yuvj4", "gray")):
        return np.asarray(picture.to_ndarray(format="gray"))
    plane = picture.planes[0]
    rows = np.frombuffer(bytes(plane), dtype=np.uint8).reshape(picture.height, plane.line_size)
    return np.ascontiguousarray(rows[:, : picture.width])
