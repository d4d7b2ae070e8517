"""A stretch of a video as a file of its own, pictures untouched."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from worldpose.errors import InputError
from worldpose.video.frame_index import FrameIndex, index_frames


def cut_video(path: Path, start: int, stop: int, out: Path, index: FrameIndex | None = None) -> int:
    """Write some pictures of a video without coding them anew.

    Decoding begins at key frames: some pictures before the first one wanted come along, and some
    behind the last one may, from which others are predicted.

    Args:
        path: the video.
        start: number of the first picture.
        stop: one past the last.
        out: the file to write, of the same kind.
        index: of the video, where it is known; else it is made.

    Returns:
        The number that picture `start` has in the new file.

    Raises:
        InputError: no video, or it has no such pictures.
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
