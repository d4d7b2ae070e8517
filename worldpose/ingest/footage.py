"""Map from match frames to the frames of a unit's video, and missing frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.units import UnitFrames, unit_frames
from worldpose.video import FrameIndex, index_video


@dataclass(frozen=True, eq=False)
class Footage:
    """A video and its synchronization with the match's clock.

    Attributes:
        index: all frames of the video.
        frame: (frames,) match frames of all clips, rising.
        picture: (frames,) video frame of each match frame; -1 where the video lacks it.
    """

    index: FrameIndex
    frame: NDArray[np.int64]
    picture: NDArray[np.int64]

    @property
    def missing(self) -> list[list[int]]:
        """First and last match frame of each interval that the video lacks."""
        return stretches(self.frame[self.picture < 0])


def read_footage(
    path: Path,
    fps: float,
    image_size: tuple[int, int],
    frames: UnitFrames,
    clips: Sequence[tuple[str, int, int]],
) -> Footage:
    """Return a video's synchronization with the match's clock, decoding only its first frame.

    Args:
        path: a video file or a folder of images.
        fps: frames per second of match time.
        image_size: width, height from match.yaml [px].
        frames: the unit's frames in the match.
        clips: id, first match frame and number of frames of each clip.

    Raises:
        InputError: no video, another size or rate, or no frame of a clip.
    """
    index = index_video(path)
    if index.size != image_size:
        raise InputError(
            str(path),
            expected=f"{image_size[0]} x {image_size[1]} px, the size in match.yaml",
            found=f"{index.size[0]} x {index.size[1]} as shown",
            todo="Correct width and height in match.yaml, or give the video in that size.",
        )
    clock = index.on_clock(fps, str(path))
    wanted = [np.arange(first, first + count, dtype=np.int64) for _, first, count in clips]
    frame = np.unique(np.concatenate(wanted))
    number = frame + frames.offset
    inside = (number >= 0) & (number < len(clock))
    picture = np.full(len(frame), -1, dtype=np.int64)
    picture[inside] = clock[number[inside]]
    for clip, first, count in clips:
        row = int(np.searchsorted(frame, first))
        if (picture[row : row + count] < 0).all():
            begin = first + frames.offset
            raise InputError(
                f"{path}: clip {clip}",
                expected=f"frames {begin} to {begin + count - 1} of this video",
                found=f"frames 0 to {len(clock) - 1}",
                todo="Check the clip's first_frame and the camera's offset_frames.",
            )
    return Footage(index, frame, picture)


def footage_clips(spec: MatchSpec, unit_id: str) -> list[tuple[str, int, int]]:
    """Return the clips of a video: all of a static camera, its own of a broadcast camera."""
    clips = spec.clips
    if unit_id in {clip.id for clip in clips}:
        clips = (spec.clip(unit_id),)
    return [(clip.id, clip.first_frame, clip.frame_count) for clip in clips]


def footage_size(spec: MatchSpec, unit_id: str) -> tuple[int, int]:
    """Return width, height from match.yaml of a static camera or a clip's broadcast camera."""
    broadcast = {clip.id: clip.broadcast for clip in spec.clips}.get(unit_id)
    camera = spec.camera(broadcast or unit_id)
    return camera.width, camera.height


def require_footage(spec: MatchSpec, unit_id: str, path: Path) -> None:
    """Raise InputError as `read_footage` if a video contradicts match.yaml."""
    frames, clips = unit_frames(spec, unit_id), footage_clips(spec, unit_id)
    read_footage(path, spec.fps, footage_size(spec, unit_id), frames, clips)


def stretches(numbers: NDArray[np.int64]) -> list[list[int]]:
    """Return first and last of each run of consecutive numbers in rising numbers."""
    if not len(numbers):
        return []
    breaks = np.flatnonzero(np.diff(numbers) > 1)
    firsts = np.concatenate([numbers[:1], numbers[breaks + 1]])
    lasts = np.concatenate([numbers[breaks], numbers[-1:]])
    return [[int(a), int(b)] for a, b in zip(firsts, lasts, strict=True)]
