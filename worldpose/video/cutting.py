"""Extraction of a part of a video into its own file, without re-encoding."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from worldpose.errors import InputError
from worldpose.video.frame_index import FrameIndex, index_frames


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
            todo="Ask for pictures that the video has.",
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
