"""Video files from images, or from a part of another video without re-encoding."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.video.reading import FrameIndex, index_frames


def cut_video(path: Path, start: int, stop: int, out: Path, index: FrameIndex | None = None) -> int:
    """Write a range of frames of a video without re-encoding.

    Decoding begins at key frames: the file also holds some frames before the first one wanted, and
    perhaps some after the last one, from which others are predicted.

    Args:
        path: the video.
        start: number of the first frame.
        stop: one past the last.
        out: the file to write, of the same kind.
        index: of the video, if known; else it is computed.

    Returns:
        The number of frame `start` in the new file.

    Raises:
        InputError: no video, or it has no such frames.
    """
    index = index_frames(path) if index is None else index
    if not 0 <= start < stop <= len(index):
        raise InputError(
            str(path),
            expected=f"a stretch within its {len(index)} pictures",
            found=f"{start} to {stop}",
            todo="Request images that the video has.",
        )
    begin = int(np.flatnonzero(index.key[: start + 1])[-1]) if index.key[: start + 1].any() else 0
    first, end = int(index.stamps[begin]), int(index.stamps[stop - 1])
    with av.open(str(path)) as source, av.open(str(out), "w") as target:
        stream = source.streams.video[0]
        written = target.add_stream_from_template(stream)
        source.seek(first, stream=stream, backward=True, any_frame=False)
        for packet in source.demux(stream):
            if packet.dts is None or packet.pts is None or packet.pts < first:
                continue
            if packet.dts > end:
                break
            packet.pts -= first
            packet.dts -= first
            packet.stream = written
            target.mux(packet)
    return start - begin


def write_video(
    path: Path, pictures: Iterable[NDArray[np.uint8]], fps: float, *, quality: int = 20
) -> int:
    """Write images to a file and return their number; the same images give the same bytes.

    H.264 with a key frame per second if the installed FFmpeg can write it, else MPEG-4 part 2.

    Args:
        path: .mp4, written image by image.
        pictures: (height, width, 3) RGB, or (height, width) grey, all of one even size.
        fps: frames per second.
        quality: 0 is without loss, 51 the worst (H.264's constant rate factor).

    Raises:
        InputError: no image, or one of another or an odd size.
    """
    rate = Fraction(fps).limit_denominator(1001)
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    count = 0
    size: tuple[int, int] | None = None
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        assert isinstance(stream, VideoStream)  # both codecs are of video
        stream.pix_fmt = "yuv420p"
        # One thread: with more, the bytes depend on the machine.
        stream.codec_context.thread_count = 1
        stream.gop_size = max(1, round(fps))
        if codec == "libx264":
            stream.options = {"crf": str(quality), "preset": "veryfast"}
        else:
            stream.codec_context.qmax = max(1, quality // 2)
        for picture in pictures:
            if size is None:
                size = picture.shape[0], picture.shape[1]
                stream.height, stream.width = size
            if picture.shape[:2] != size or size[0] % 2 or size[1] % 2:
                raise InputError(
                    f"{path}: picture {count}",
                    expected="images of one size, with even width and height",
                    found=f"{picture.shape[1]} x {picture.shape[0]}",
                    todo="Cut or scale the pictures.",
                )
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(picture), format="rgb24" if picture.ndim == 3 else "gray"
            )
            for packet in stream.encode(frame):
                container.mux(packet)
            count += 1
        if size is None:
            raise InputError(
                str(path), expected="one picture or more", found="none", todo="Give some."
            )
        for packet in stream.encode(None):
            container.mux(packet)
    return count
