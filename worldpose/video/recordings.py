"""Recordings as cameras and disks leave them: chapters, fields, files that end early, and DPX."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream

from data_contracts.arrays import Image
from worldpose.errors import InputError
from worldpose.video.files import (
    VideoReader,
    decode_packets,
    index_frames,
    no_video,
    open_file,
    read_packets,
)
from worldpose.video.pictures import FrameIndex, convert_pixels


def join_videos(parts: Sequence[Path], out: Path) -> None:
    """Write chapters of one recording as one file, not encoded again; InputError if they differ."""
    if parts[0].suffix.lower() == ".vob":  # parts of one stream, cut between any two packets
        index_frames(parts[0])  # what is wrong with all of them is said of a file of the user
        with out.open("wb") as whole:
            for part in parts:
                with part.open("rb") as source_bytes:
                    shutil.copyfileobj(source_bytes, whole)
        index_frames(out)
        return
    indices = [index_frames(part) for part in parts]
    base = indices[0].time_base
    written: VideoStream | None = None
    begin = 0
    with av.open(str(out), "w") as target:
        for part, index in zip(parts, indices, strict=True):
            with open_file(part) as source:
                stream = source.streams.video[0]
                if written is None:
                    written = target.add_stream_from_template(stream)
                for packet in read_packets(source, stream):
                    if packet.dts is None or packet.pts is None:
                        continue
                    packet.pts += begin - int(index.stamps[0])
                    packet.dts += begin - int(index.stamps[0])
                    packet.stream = written
                    try:
                        target.mux(packet)
                    except av.error.FFmpegError:  # times that this kind of file cannot have
                        break
            step = round(float(np.median(np.diff(index.stamps)))) if len(index) > 1 else 1
            begin += int(index.stamps[-1] - index.stamps[0]) + step
    count, joined = sum(map(len, indices)), index_frames(out)
    if {(i.size, i.time_base) for i in indices} != {(joined.size, base)} or len(joined) != count:
        raise InputError(
            ", ".join(map(str, parts)),
            expected=f"chapters of one recording, {count} frames together",
            found=f"{len(joined)} frames of {joined.size[0]} x {joined.size[1]} px",
            todo="Join them with a video tool, and import the result.",
        )


def cut_video(path: Path, start: int, stop: int, out: Path) -> int:
    """Write frames from `start` to before `stop` of a video to a file of its kind, as encoded.

    Decoding begins at key frames: the file also holds some frames before the first one wanted, and
    perhaps some after the last one, from which others are predicted. Return the number of frame
    `start` in the new file; InputError if the video has no such frames.
    """
    index = index_frames(path)
    if not 0 <= start < stop <= len(index):
        expected = f"a stretch within its {len(index)} pictures"
        todo = "Request images that the video has."
        raise InputError(str(path), expected, f"{start} to {stop}", todo)
    if index.is_counted:
        raise no_video(path, "one that does not say when each picture is shown")
    with VideoReader(path, index) as source, av.open(str(out), "w") as target:
        begin = source.key_before(start)
        first, end = int(index.stamps[begin]), int(index.stamps[stop - 1])
        written: VideoStream | None = None
        for packet in source.packets_from(begin):
            if packet.dts is None or packet.pts is None or packet.pts < first:
                continue
            if packet.dts > end:
                break
            if written is None:
                written = target.add_stream_from_template(packet.stream)
            packet.pts -= first
            packet.dts -= first
            packet.stream = written
            target.mux(packet)
    return start - begin


def read_dpx(file: Path, *, grey: bool) -> Image | None:
    """Return an image (height, width, 3) RGB, or (height, width) grey; None if it is none."""
    try:
        with open_file(file, "dpx_pipe") as container:
            picture = next(iter(container.decode(video=0)), None)
            return None if picture is None else convert_pixels(picture, grey, None)
    except (av.error.FFmpegError, OSError, ValueError):
        return None


def describe_video(path: Path, index: FrameIndex) -> list[str]:
    """Return sentences about fields in a video's frames, and about a file that ends early."""
    if path.is_dir():
        return []
    notes = []
    with open_file(path) as container:
        stream = container.streams.video[0]
        duration = stream.duration and float(stream.duration * (index.time_base or 1))
        if duration is None and container.duration is not None and len(container.streams) == 1:
            duration = container.duration / av.time_base
        picture = next(decode_packets(read_packets(container, stream)), None)
    if picture is not None and picture.interlaced_frame:
        notes.append(
            f"{path.name}: its frames are interlaced: each has two fields of different times, which"
            " comb people who move. Make a frame of each field: ffmpeg -i IN -vf "
            f"bwdif=mode=send_field OUT ({2 * index.fps:g} frames per second). Nothing is to be "
            "done if the camera was progressive."
        )
    length = float(index.times[-1]) if index.time_base is not None else 0.0
    copy_again = "If it was cut off, or is still being copied, give the whole file."
    if duration is not None and length < 0.98 * duration - 0.5:
        notes.append(
            f"{path.name}: its frames end at {length:.2f} s, but it states {duration:.2f} s. "
            + copy_again
        )
    elif _ends_within_packet(path):
        notes.append(f"{path.name}: it ends within a packet. " + copy_again)
    return notes


def _ends_within_packet(path: Path) -> bool:
    """Return whether a file of a transport stream, of packets of one size, has a part of one."""
    with path.open("rb") as file:
        begin = file.read(2048)
    for size, first in ((188, 0), (192, 4)):  # the second has a time before each packet
        if len(begin) > 4 * size and set(begin[first : first + 4 * size : size]) == {0x47}:
            return path.stat().st_size % size != 0
    return False
