"""Frames of a video by number, from the time stamps of all frames in display order, and writing.

Videos are written from images, or cut from another video without re-encoding.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import chain, dropwhile, islice, pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream
from numpy.typing import NDArray

from data_contracts.arrays import Image
from worldpose.errors import InputError, say_failure
from worldpose.video.pictures import MAX_FRAME_PIXELS, FrameIndex, Pictures, convert_pixels


def open_file(path: Path, form: str | None = None) -> InputContainer:
    """Open a file whose frames decode only within `MAX_FRAME_PIXELS`, whatever its header says.

    Threads keep one frame each, so that large frames get few of them. InputError if the file is a
    list of other files, which can be outside of its folder.
    """
    limit = {"max_pixels": str(MAX_FRAME_PIXELS)}
    local = {"protocol_whitelist": "file"}
    container = av.open(str(path), format=form, options=limit, container_options=local)
    if {"concat", "hls", "dash", "sdp", "imf"} & {*container.format.name.split(",")}:
        container.close()
        raise no_video(path, "a list of other files")
    for stream in container.streams.video:
        if stream.codec_context is not None:
            stream.codec_context.options = limit
            stream.thread_type = "AUTO"
            pixels = max(1, stream.width * stream.height)
            if 16 * pixels > MAX_FRAME_PIXELS:
                stream.codec_context.thread_count = 2 * MAX_FRAME_PIXELS // pixels
    return container


def holds_video(path: Path) -> bool:
    """Return whether FFmpeg finds a video in a file's content: no image, sound, text or list."""
    try:
        with path.open("rb") as file:
            if file.read(7) == b"#EXTM3U":  # FFmpeg waits for the rest of a live list
                return False
        with open_file(path) as container:
            others = "_pipe|image2|tty|bin|adf|idf|gif|ico|fits"
            is_other = re.search(others, container.format.name)
            return not is_other and bool(_films(container))
    except (InputError, av.error.FFmpegError, OSError):
        return False


def index_frames(path: Path) -> FrameIndex:
    """Return the index of a file's first video stream, from its packets: it decodes one frame.

    It decodes all frames of a file whose packets do not say when each frame is shown. InputError
    for no video, frames without time stamps, or stamps that start again.
    """
    try:
        with open_file(path) as container:
            if not container.streams.video:
                raise no_video(path, "no video stream")
            _require_alone(path, container)
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise no_video(path, "a video stream that this program has no decoder for")
            if not stream.width * stream.height:
                said = f"frames without a size, or of more than {MAX_FRAME_PIXELS:,} pixels"
                raise no_video(path, said)
            size: tuple[int, int] | None = None
            packets: list[tuple[int | None, bool, int | None]] = []
            for packet in read_packets(container, stream):
                size = _shown_size(path, packet) if size is None else size
                if packet.size and not packet.is_discard:
                    packets.append((packet.pts, packet.is_keyframe, packet.dts))
            _require_one(path, packets)
            size = (stream.width, stream.height) if size is None else size
            _require_square(path, stream)
            base = stream.time_base
            reorders = stream.codec_context.has_b_frames
        given = [stamp for stamp, _, _ in packets if stamp is not None]
        if not given or base is None:
            raise no_video(path, f"{len(packets)} pictures without time stamps")
        is_told = len(set(given)) == len(packets)
        # The order of decoding, although the codec may decode a frame before one shown earlier?
        if is_told and reorders and given == sorted(given):
            # No codec delays more than 16 frames.
            is_told = _rise(_shown_stamps(path, 64))
        if not is_told:
            return _count_frames(path, given, len(packets), base, size)
    except (av.error.FFmpegError, OSError) as error:
        is_empty = path.is_file() and not path.stat().st_size
        found = "an empty file" if is_empty else error.strerror or say_failure(error)
        raise no_video(path, found) from error
    stamps = np.array(given, dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    key = np.array([key for _, key, _ in packets], dtype=np.bool_)[order]
    return FrameIndex(stamps[order], key, base, size)


def _count_frames(
    path: Path, given: Sequence[int], count: int, base: Fraction, size: tuple[int, int]
) -> FrameIndex:
    """Return the index of a video whose packets do not say when each frame is shown."""
    shown = _shown_stamps(path)
    if len(shown) != count:
        found = f"{count} pictures, of which {len(shown)} can be decoded, not all with time stamps"
        raise no_video(path, found + ": does it begin or end within a group of pictures?")
    stamps = np.sort(np.array(given, dtype=np.int64))
    if len(np.unique(stamps)) < count:
        known = np.array([number for number, stamp in enumerate(shown) if stamp is not None])
        times = np.array([stamp for stamp in shown if stamp is not None], dtype=np.float64)
        spans = len(known) > 1 and times[-1] > times[0]
        step = (times[-1] - times[0]) / (known[-1] - known[0]) if spans else 0.0
        if not spans or np.abs(times[0] + step * (known - known[0]) - times).max() > 0.5 * step:
            raise no_video(path, f"{count} pictures, not all with time stamps")
        stamps = np.rint(times[0] + step * (np.arange(count) - known[0])).astype(np.int64)
    return FrameIndex(stamps, np.arange(count) == 0, base, size, is_counted=True)


def _shown_stamps(path: Path, most: int | None = None) -> list[int | None]:
    """Return the time stamps of all frames, or of the first `most`, in the order shown."""
    with open_file(path) as container:
        stream = container.streams.video[0]
        pictures = decode_packets(read_packets(container, stream))
        return [picture.pts for picture in islice(pictures, most)]


def _rise(stamps: Sequence[int | None]) -> bool:
    """Return whether time stamps are known and rise."""
    known = [stamp for stamp in stamps if stamp is not None]
    return len(known) == len(stamps) and all(one < two for one, two in pairwise(known))


def read_packets(
    container: InputContainer, stream: VideoStream
) -> Iterator[av.Packet[VideoStream]]:
    """Yield the packets of a stream; a truncated file ends where it was cut."""
    packets = container.demux(stream)
    is_gxf, before = container.format.name == "gxf", None
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            return
        if packet is None:
            return
        if is_gxf and packet.pts is not None and packet.dts is not None:
            if before is not None and packet.dts - before == 2:  # fields: the last comes one early
                packet.pts += (packet.pts - packet.dts) % 2
            before = packet.dts
        yield packet


def decode_packets(packets: Iterable[av.Packet[VideoStream]]) -> Iterator[av.VideoFrame]:
    """Yield the frames in the order shown, without those of packets that cannot be decoded."""
    for packet in packets:
        try:
            shown = packet.decode()
        except av.error.FFmpegError:
            continue  # its frames are missing; those after the next key frame are not
        for picture in shown:
            assert isinstance(picture, av.VideoFrame)  # of a video stream
            yield picture


def _shown_size(path: Path, packet: av.Packet[VideoStream]) -> tuple[int, int] | None:
    """Return width and height as displayed: an upright camera stores rotated frames."""
    for picture in decode_packets([packet]):
        _require_quarters(path, picture)
        if picture.rotation % 180:
            return picture.height, picture.width
        return picture.width, picture.height
    return None


def _require_quarters(path: Path, picture: av.VideoFrame) -> None:
    """Raise InputError for a display matrix that mirrors, or turns by no multiple of 90 degrees."""
    stored: Any = picture.side_data.get("DISPLAYMATRIX")
    if stored is None:
        return
    matrix = np.frombuffer(bytes(stored), np.int32)[:9].reshape(3, 3)[:2, :2].astype(np.float64)
    turn = float(np.degrees(np.arctan2(matrix[0, 1], matrix[0, 0])))
    is_mirrored, off = np.linalg.det(matrix) < 0.0, abs((turn + 45.0) % 90.0 - 45.0)
    if matrix[0].any() and not is_mirrored and off < 1.0:
        return
    raise InputError(
        str(path),
        expected="images that are shown upright, or turned by 90, 180 or 270 degrees",
        found="a display matrix that mirrors them"
        if is_mirrored
        else f"a display matrix that turns them by {turn:.0f} degrees"
        if matrix.any()
        else "an empty display matrix",
        todo="Convert the video, so that its images are stored as shown: ffmpeg -i IN -c:v libx264 "
        "-crf 12 OUT.",
    )


def _require_square(path: Path, stream: VideoStream) -> None:
    """Raise InputError for a video whose pixels are wider or narrower than high."""
    max_stretch = 0.01  # largest deviation of a pixel's sides that rounding in a file explains [1]
    ratio = stream.sample_aspect_ratio
    if ratio and abs(float(ratio) - 1.0) > max_stretch:
        raise InputError(
            str(path),
            expected="square pixels",
            found=f"a sample aspect ratio of {ratio.numerator}:{ratio.denominator}",
            todo="Make them square: ffmpeg -i IN -vf scale=trunc(iw*sar/2)*2:ih,setsar=1 OUT; a "
            "calibration of the stretched pictures has to be made again.",
        )


def _films(container: InputContainer) -> list[tuple[int, int, int]]:
    """Return number, width and height of each stream of video that is no picture of a cover."""
    return [
        (stream.index, stream.width, stream.height)
        for stream in container.streams.video
        if stream.codec_context is not None
        and stream.width * stream.height
        and not stream.disposition & (Disposition.attached_pic | Disposition.timed_thumbnails)
    ]


def _require_alone(path: Path, container: InputContainer) -> None:
    """Raise InputError for a file with videos of several cameras or programmes."""
    films = _films(container)
    if len(films) > 1:
        found = ", ".join("stream {} of {} x {} px".format(*film) for film in films)
        todo = "Give each as a file of its own: ffmpeg -i IN -map 0:NUMBER -c copy OUT."
        raise InputError(str(path), "one video stream", found, todo)


def _require_one(path: Path, packets: Sequence[tuple[int | None, bool, int | None]]) -> None:
    """Raise InputError where the times of decoding, or of key frames, go back."""
    # Up to the first key frame, if it is not the first frame, FFmpeg makes the times up.
    first = next((number for number, (_, key, _) in enumerate(packets) if key), 0)
    known = [(n, time) for n, (_, _, time) in enumerate(packets) if time is not None]
    dts = [(n, time) for n, time in known if n > first or not first]
    keys = [
        (number, pts) for number, (pts, key, _) in enumerate(packets) if key and pts is not None
    ]
    for (_, before), (number, time) in chain(pairwise(dts), pairwise(keys)):
        if time < before:
            found = f"they go back at frame {number}, as where two recordings are joined"
            todo = "Give each recording as a file of its own, or join them by ffmpeg -f concat."
            raise InputError(str(path), "time stamps that rise", found, todo)


def no_video(path: Path, found: str) -> InputError:
    """Return the error of a file that is no video to be read."""
    todo = "Give an mp4, mov or mkv file; convert others with any video tool."
    return InputError(str(path), "a video file with time stamps", found, todo)


class VideoReader(Pictures):
    """A video file with access to frames by number, forwards without seeking."""

    def __init__(self, path: Path, index: FrameIndex | None = None) -> None:
        """Open a file, with its index or a computed one; InputError if it is no video."""
        self.path = path
        self.index = index_frames(path) if index is None else index
        self._number = {int(stamp): number for number, stamp in enumerate(self.index.stamps)}
        self._open()
        # Where several frames are in a packet of a program stream, the first time stamps after a
        # seek are those of other frames.
        is_packed = self._container.format.name == "mpeg"
        self._lead = round(0.5 / self.index.time_base) if is_packed and self.index.time_base else 0

    def _open(self) -> None:
        self._container = open_file(self.path)
        self._stream = self._container.streams.video[0]

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def readable(
        self,
        start: int = 0,
        stop: int | None = None,
        *,
        grey: bool = False,
        width: int | None = None,
        only: Collection[int] | None = None,
    ) -> Iterator[tuple[int, Image | None]]:
        """Yield frames as `frames` does, with None for each damaged or undecodable one.

        Frames after a damaged one up to the next key frame are None too: they may be predicted from
        it. RGB images get `width`, before rotation [px]; None = unscaled. Frames that are not in
        `only` are decoded, but not converted; None = all. InputError also if one has another size.
        """
        stop = len(self) if stop is None else stop
        if not 0 <= start <= stop <= len(self):
            expected = f"frames from 0 to {len(self)}"
            todo = "Ask for frames that the video has."
            raise InputError(str(self.path), expected, f"{start} to {stop}", todo)
        for number, picture in self._sound_pictures(start, stop) if start < stop else ():
            self._require_size(number, picture)
            if number >= start and (only is None or number in only):
                yield number, None if picture is None else convert_pixels(picture, grey, width)

    def _require_size(self, number: int, picture: av.VideoFrame | None) -> None:
        """Raise InputError for a frame of another size than the first one."""
        shown = self.index.size if picture is None else (picture.width, picture.height)
        shown = shown[::-1] if picture is not None and picture.rotation % 180 else shown
        if shown != self.index.size:
            expected = "images of {} x {} px, as the first one".format(*self.index.size)
            found, todo = "{} x {}".format(*shown), "Give a video of one camera in one mode."
            raise InputError(f"{self.path}: frame {number}", expected, found, todo)

    def _sound_pictures(self, start: int, stop: int) -> Iterator[tuple[int, av.VideoFrame | None]]:
        """Yield every frame from the last key frame up to `start` on; None if damaged."""
        wanted = sound_from = self.key_before(start)
        for number, picture in self._shown_from(start):
            if number < wanted:
                continue
            if number > wanted or picture.is_corrupt:
                sound_from = self._next_key(wanted)
            while wanted < min(number, stop):
                yield wanted, None
                wanted += 1
            if wanted < stop:
                yield wanted, picture if wanted >= sound_from else None
                wanted += 1
            if wanted == stop:
                return
        for number in range(wanted, stop):
            yield number, None

    def key_before(self, number: int) -> int:
        """Return the last frame up to `number` at which decoding can begin; 0 if none."""
        return int(self._keys(number)[-1])

    def _keys(self, number: int) -> NDArray[np.intp]:
        """Return the frames up to `number` at which decoding can begin; the first if none."""
        keys = np.flatnonzero(self.index.key[: number + 1])
        return keys if len(keys) else np.zeros(1, dtype=np.intp)

    def _next_key(self, number: int) -> int:
        """Return the first frame after a damaged one that is not predicted from it."""
        keys = np.flatnonzero(self.index.key)
        after = int(np.searchsorted(keys, number, side="right"))
        return int(keys[after]) if after < len(keys) else len(self)

    def _shown_from(self, start: int) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield numbers and displayed frames, from the last key frame up to `start` on.

        Where the picture is refreshed stripe by stripe, a key frame itself is whole only if
        decoding began before it.
        """
        # Damaged key frames are never whole.
        keys = self._keys(start)[-3:]
        first = None
        for begin in keys[::-1].tolist():
            shown = self._number_shown(begin)
            first = next((each for each in shown if each[0] >= keys[-1]), None)
            if first is not None and first[0] == keys[-1]:
                break
        if first is not None:
            yield first
            yield from shown

    def _number_shown(self, begin: int) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield frames as decoding from frame `begin` on shows them, with their numbers or -1."""
        for count, picture in enumerate(decode_packets(self.packets_from(begin))):
            stamp = -1 if picture.pts is None else int(picture.pts)
            yield count if self.index.is_counted else self._number.get(stamp, -1), picture

    def packets_from(self, begin: int) -> Iterator[av.Packet[VideoStream]]:
        """Yield the packets from a key frame, or the first frame, on.

        Many containers seek by the time of decoding, or roughly: where the frame is not ahead, the
        next try seeks earlier, in the end from the beginning of the file. Without a key frame up to
        it, decoding begins there: packets before it may be of a key frame shown later.
        """
        stamp, is_key = int(self.index.stamps[begin]), bool(self.index.key[begin])
        lead = self._lead
        while stamp - lead >= self.index.stamps[0] and not self.index.is_counted and is_key:
            try:
                self._container.seek(stamp - lead, stream=self._stream)
            except av.error.FFmpegError:
                break
            packets = read_packets(self._container, self._stream)
            for packet in packets:
                if packet.pts == stamp:
                    self._lead = lead
                    yield packet
                    yield from packets
                    return
                if packet.pts is not None and packet.pts > stamp:
                    break  # too late
            assert self.index.time_base is not None  # of a video file
            lead = 2 * lead or max(1, round(0.5 / self.index.time_base))
        self.close()
        self._open()
        packets = read_packets(self._container, self._stream)
        if is_key and not self.index.is_counted:
            packets = dropwhile(lambda packet: packet.pts != stamp, packets)
        yield from packets

    def damage_error(self, number: int) -> InputError:
        """Return the error of a frame that cannot be decoded."""
        return InputError(
            f"{self.path}: frame {number}",
            expected="a picture",
            found="one that cannot be decoded",
            todo="Convert the video with any video tool.",
        )


def write_video(path: Path, pictures: Iterable[Image], fps: float, *, quality: int = 20) -> int:
    """Write images to a file and return their number; the same images give the same bytes.

    H.264 with a key frame per second if the installed FFmpeg can write it, else MPEG-4 part 2, of
    (height, width, 3) RGB, or (height, width) grey. A quality of 0 is without loss, 51 the worst
    (H.264's constant rate factor). InputError for no image, or one of another or an odd size.
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
