"""Data of one unit of a match folder: frames, detections, calibration, video and still."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import ClockOffset, MatchSpec
from data_contracts.usability import UsableLimits
from worldpose.errors import InputError
from worldpose.formats.files import require_file
from worldpose.formats.keypoint_files import read_people, select_ranges
from worldpose.ingest.clock import ImageClock, camera_frames
from worldpose.ingest.match_folder import MatchFolder

if TYPE_CHECKING:
    from worldpose.video.pictures import FrameIndex


@dataclass(frozen=True)
class UnitFrames:
    """Match frames of a static camera, or of a broadcast view.

    Attributes:
        first: first match frame.
        count: number of frames, including those between clips.
        offset: camera frame minus match frame, see `worldpose.ingest.clock`.
        ranges: first match frame and number of frames of every interval covered by clips, rising
            and disjoint: only these contain people.
        rate: frames of the camera per match frame.
    """

    first: int
    count: int
    offset: ClockOffset
    ranges: tuple[tuple[int, int], ...] = ()
    rate: float = 1.0

    @property
    def frame(self) -> NDArray[np.int64]:
        """Match frames (n,) of the ranges."""
        return np.concatenate([np.arange(first, first + count) for first, count in self.ranges])

    @property
    def clock(self) -> list[Any]:
        """Offset and rate, as recipes list them."""
        offset = self.offset
        pairs = [list(pair) for pair in offset] if isinstance(offset, tuple) else offset
        return [pairs, self.rate]

    def numbers(self, frame: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the camera frame (n,) that is nearest to each match frame (n,)."""
        return camera_frames(frame, self.offset, self.rate)

    def number(self, frame: int) -> int:
        """Return the camera frame that is nearest to a match frame."""
        return int(self.numbers(np.array([frame]))[0])

    def place(self, path: Path, people: KeypointDetections) -> KeypointDetections:
        """Return people on the match frames of the ranges; InputError if all are outside."""
        frame = self.frame
        number, row = np.unique(self.numbers(frame), return_inverse=True)
        ranges = [(first, last - first + 1) for first, last in stretches(number)]
        return replace(select_ranges(path, people, ranges)[row], frame=frame)


def unit_frames(spec: MatchSpec, unit_id: str) -> UnitFrames:
    """Return the frames of a unit: all clips of a static camera, the clip of a broadcast view.

    At the match's frame rate, the function rounds a broadcast offset to the nearest frame; the rest
    stays in the clip's `broadcast_offset_frames`.
    """
    view = spec.broadcast_view(unit_id)
    camera = spec.camera(unit_id) if view is None else view.camera
    rate = (camera.fps or spec.fps) / spec.fps
    offset = camera.offset_frames
    if view is not None:
        start = round(view.offset) if rate == 1.0 else view.offset
        offset = start - view.clip.first_frame * rate
    if isinstance(offset, float) and offset.is_integer():
        offset = int(offset)
    ranges: list[tuple[int, int]] = []
    spans = ((c.first_frame, c.first_frame + c.frame_count) for c in spec.clips_of(unit_id))
    for first, stop in sorted(spans):
        if ranges and first <= sum(ranges[-1]):
            begin, count = ranges[-1]
            ranges[-1] = (begin, max(begin + count, stop) - begin)
        else:
            ranges.append((first, stop - first))
    first = ranges[0][0]
    return UnitFrames(first, sum(ranges[-1]) - first, offset, tuple(ranges), rate)


def image_clock(spec: MatchSpec, name: str) -> ImageClock:
    """Return the images of a broadcast view."""
    frames = unit_frames(spec, name)
    return ImageClock.of(
        frames.frame, frames.offset, frames.rate, spec.broadcast_views[name].offset
    )


def read_unit(
    match: MatchFolder, unit_id: str
) -> tuple[KeypointDetections, CameraCalibration | None]:
    """Return detections and given calibration of a static camera or a broadcast view.

    Args:
        match: match as read by `read_match`.
        unit_id: id of a static camera, or name of a broadcast view.

    Returns:
        Detections with `frame` in match frames, and the calibration if given.

    Raises:
        InputError: the match has no such unit, or no or invalid detections for it.
    """
    if unit_id not in match.detections:
        expected = f"2D poses of {unit_id!r} ({unit_id}.json or {unit_id}.npz)"
        found = f"those of {', '.join(match.detections) or 'none'}"
        raise InputError(
            str(match.folder / "detections"), expected, found, "Add the file, or correct the name."
        )
    path = match.detections[unit_id]
    people = unit_frames(match.spec, unit_id).place(path, read_people(path).people)
    return people, match.calibrations.get(unit_id)


def uncovered_clips(match: MatchFolder) -> Iterator[str]:
    """Yield a warning for each clip whose 2D poses begin late, or end early, in all its cameras.

    Shorter times without people are no reason for a reservation either (`UsableLimits`).
    """
    spec, seen = match.spec, dict[str, NDArray[np.int64]]()
    for unit in match.detections:
        people, _ = read_unit(match, unit)
        seen[unit] = people.frame[np.isfinite(people.score).any(axis=1)]
    for clip in spec.clips:
        units = [*(camera.id for camera in spec.static_cameras), *spec.views_of(clip.id)]
        if not units or not {*units} <= seen.keys():
            continue  # no camera films it, or a detector finds the people of the others
        first, last = clip.first_frame, clip.first_frame + clip.frame_count - 1
        frame = np.concatenate([seen[unit] for unit in units])
        frame = frame[(frame >= first) & (frame <= last)]
        begin, end = (int(frame.min()), int(frame.max())) if len(frame) else (last + 1, last)
        most = max(spec.fps, UsableLimits().max_absent_share * clip.frame_count)
        if max(begin - first, last - end) > most:
            where = f"only in frames {begin} to {end}" if len(frame) else "in no frame"
            yield (
                f"clip {clip.id}: it has frames {first} to {last}, and 2D poses {where}. Shorten "
                "it (first_frame, frame_count), or give the 2D poses of the rest."
            )


@dataclass(frozen=True, eq=False)
class Footage:
    """A video and its synchronization with the match's clock.

    Attributes:
        index: all frames of the video.
        frame: (frames,) match frames of all clips, rising.
        picture: (frames,) video frame of each match frame; -1 where the video lacks it.
        length: number of frames of the camera's clock from the video's first to its last.
    """

    index: FrameIndex
    frame: NDArray[np.int64]
    picture: NDArray[np.int64]
    length: int

    def shows(self, first: int, count: int) -> bool:
        """Return whether the video has an image of a clip."""
        row = int(np.searchsorted(self.frame, first))
        return bool((self.picture[row : row + count] >= 0).any())

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
    index: FrameIndex | None = None,
) -> Footage:
    """Return a video's synchronization with the match's clock, decoding only its first frame.

    `fps` [1/s] and `image_size`, width, height [px], are those of match.yaml. A clip is id, first
    match frame and number of frames; `index` None is read from the video. InputError for no video,
    another size or rate, or no frame of any clip.
    """
    from worldpose.video.folder import index_video  # late: most commands open no video

    index = index_video(path) if index is None else index
    if index.size != image_size:
        expected = f"{image_size[0]} x {image_size[1]} px, the size in match.yaml"
        todo = "Correct width and height in match.yaml, or give the video in that size."
        raise InputError(str(path), expected, f"{index.size[0]} x {index.size[1]} as shown", todo)
    wanted = [np.arange(first, first + count, dtype=np.int64) for _, first, count in clips]
    frame = np.unique(np.concatenate(wanted))
    picture = index.shown(frames.numbers(frame), fps, str(path))
    found = Footage(index, frame, picture, len(index.on_clock(fps, str(path))))
    if (picture < 0).all():
        raise no_images(path, found, frames, clips[0])
    return found


def no_images(
    path: Path, footage: Footage, frames: UnitFrames, clip: tuple[str, int, int]
) -> InputError:
    """Return the error of a video that shows no frame of a clip (id, first, count)."""
    name, first, count = clip
    begin, end = frames.numbers(np.array([first, first + count - 1]))
    expected = f"frames {begin} to {end} of this video"
    todo = "Check the clip's first_frame and the camera's offset_frames."
    return InputError(f"{path}: clip {name}", expected, f"frames 0 to {footage.length - 1}", todo)


def footage_clips(spec: MatchSpec, unit_id: str) -> list[tuple[str, int, int]]:
    """Return the clips of a video: all of a static camera, one of a broadcast view."""
    return [(clip.id, clip.first_frame, clip.frame_count) for clip in spec.clips_of(unit_id)]


def footage_size(spec: MatchSpec, unit_id: str) -> tuple[int, int]:
    """Return width, height from match.yaml of a static camera or a broadcast view."""
    camera = spec.filming_camera(unit_id) or spec.camera(unit_id)
    return camera.width, camera.height


def require_footage(
    spec: MatchSpec,
    unit_id: str,
    path: Path,
    index: FrameIndex | None = None,
    *,
    whole: bool = False,
) -> dict[str, InputError]:
    """Raise InputError as `read_footage` if a video contradicts match.yaml.

    With `whole`, the video also has the first and the last frame of its clips. Returned is, for
    each clip of which the video has no image, the error if no other camera has one.
    """
    frames, clips = unit_frames(spec, unit_id), footage_clips(spec, unit_id)
    fps = spec.fps * frames.rate
    footage = read_footage(path, fps, footage_size(spec, unit_id), frames, clips, index)
    number = frames.numbers(footage.frame)
    fits = int(np.count_nonzero((number >= 0) & (number < footage.length)))
    if whole and fits < len(number):
        raise InputError(
            f"{path}: frame_count and broadcast_offset_frames of clip {clips[0][0]}",
            expected=f"frames of this video, 0 to {footage.length - 1}",
            found=f"{number[0]} to {number[-1]}",
            todo=f"Correct the offset, or shorten the clip to the {fits} frames that fit.",
        )
    unseen = [clip for clip in clips if not footage.shows(clip[1], clip[2])]
    return {clip[0]: no_images(path, footage, frames, clip) for clip in unseen}


def stretches(numbers: NDArray[np.int64]) -> list[list[int]]:
    """Return first and last of each run of consecutive numbers in rising numbers."""
    if not len(numbers):
        return []
    breaks = np.flatnonzero(np.diff(numbers) > 1)
    firsts = np.concatenate([numbers[:1], numbers[breaks + 1]])
    lasts = np.concatenate([numbers[breaks], numbers[-1:]])
    return [[int(a), int(b)] for a, b in zip(firsts, lasts, strict=True)]


def read_still(path: str | os.PathLike[str], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the image (height, width, 3), RGB.

    Args:
        path: a PNG, JPEG, TIFF, BMP or WebP file.
        image_size: width and height of the camera [px].

    Raises:
        InputError: no such file, no image, or another image size.
    """
    still_bytes = 1 << 28  # maximum size of a still [byte]; a noisy 4K image has 25 MB
    from worldpose.video.folder import MAX_PIXELS, declared_size, decode_image  # late: as above

    path = Path(path)
    size = require_file(path)
    content = np.fromfile(path, dtype=np.uint8) if size <= still_bytes else np.empty(0, np.uint8)
    declared = declared_size(content)
    image_size = (image_size[0], image_size[1])
    if declared is not None and declared != image_size:
        found = f"{declared[0]} x {declared[1]} as shown, with the turn of its EXIF tag"
        todo = "Export the still at the size of the video, or correct match.yaml."
        raise InputError(
            str(path), f"{image_size[0]} x {image_size[1]} px, the size in match.yaml", found, todo
        )
    image = decode_image(content)
    if image is None:
        expected = f"an image of at most {still_bytes} bytes and {MAX_PIXELS} pixels"
        todo = "Export the still again."
        raise InputError(str(path), expected, f"{size} bytes that are none", todo)
    return image


def write_still(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an image (height, width, 3), RGB, as PNG; equal images give equal bytes."""
    import cv2  # late: it takes 0.2 s, and few commands open an image

    path.parent.mkdir(parents=True, exist_ok=True)
    _, content = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    path.write_bytes(content.tobytes())
