"""Frames of a video by number, from the time stamps of all frames in display order, and writing.

Videos are written from images, or cut from another video without re-encoding.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final, Self

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


class VideoReader:
    """A video file with access to frames by number, forwards without seeking."""

    def __init__(self, path: Path, index: FrameIndex | None = None) -> None:
        """Open a file.

        Args:
            path: the video.
            index: index of the video; if None, it is computed.

        Raises:
            InputError: no video.
        """
        self.path = path
        self.index = index_frames(path) if index is None else index
        self._container = av.open(str(path))
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._number = {int(stamp): number for number, stamp in enumerate(self.index.stamps)}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
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
        only: Collection[int] | None = None,
    ) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        """Yield frames as `frames` does, with None for each damaged or undecodable one.

        Frames after a damaged one up to the next key frame are None too: they may be predicted from
        it.

        Args:
            start: first frame.
            stop: one past the last; the end of the video if None.
            grey: luma instead of RGB.
            width: RGB images get this width, before rotation [px]; None = unscaled.
            only: frames to yield; the others are decoded, but not converted. None = all.

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
                if only is None or wanted in only:
                    yield wanted, None
                wanted += 1
            if wanted < stop:
                if only is None or wanted in only:
                    yield wanted, _pixels(picture, grey, width) if wanted >= sound_from else None
                wanted += 1
            if wanted == stop:
                return
        for number in range(wanted, stop):
            if only is None or number in only:
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


def cut_video(path: Path, start: int, stop: int, out: Path) -> int:
    """Write a range of frames of a video without re-encoding.

    Decoding begins at key frames: the file also holds some frames before the first one wanted, and
    perhaps some after the last one, from which others are predicted.

    Args:
        path: the video.
        start: number of the first frame.
        stop: one past the last.
        out: the file to write, of the same kind.

    Returns:
        The number of frame `start` in the new file.

    Raises:
        InputError: no video, or it has no such frames.
    """
    index = index_frames(path)
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
