"""Videos of a folder by camera: files, folders of images, and recordings in chapters."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image, Integers
from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.calibration_files import camera_id
from worldpose.formats.calibration_unit import scaled
from worldpose.ingest.footage import stretches
from worldpose.video.files import holds_video
from worldpose.video.folder import SUFFIXES, numbered_images, open_video
from worldpose.video.names import VIDEO_SUFFIXES, is_video
from worldpose.video.pictures import FrameIndex
from worldpose.video.recordings import describe_video, join_videos

_CHAPTER: Final = re.compile(
    r"(.*)(?:(?:(G[HXLS]|GP)(\d\d)|GOPR)(\d{4})|(VTS)_(\d\d)_([1-9]))", re.IGNORECASE
)
"""Names of GoPro and DVDs: GX020017 is chapter 2 of recording 17, GP010017 that after GOPR0017,
and VTS_01_2 part 2 of title set 1."""


def find_videos(
    folder: Path, workshop: Path | None = None, *, named: bool = False
) -> dict[str, Path]:
    """Return the video of each camera in a folder: a file, or a folder of numbered images.

    A camera is called as its file or folder. Chapters of one recording are in the folder, or in a
    folder of the camera, as may be its only video, unless a file beside that folder has its name.
    They are joined in `workshop`; InputError without one, or if two videos have one name. If
    `named`, each file of the folder is the video of a camera, even if it is named as a chapter.
    """
    videos = _films_in(folder)
    groups = [[file] for file in videos] if named else _recordings(videos)
    for place in (each for each in sorted(folder.glob("[!.]*")) if each.is_dir()):
        inside = [[place]] if _has_images(place) else _recordings(_films_in(place))
        groups += [group for group in inside if len(group) > 1 or len(inside) == 1]
    found: dict[str, Path] = {}
    first: dict[str, Path] = {}
    for group in groups:
        place = group[0].parent if group[0].parent != folder else group[0]
        name = camera_id(place.stem if place.is_file() else place.name)
        if name in found:
            if len(group) == 1 and group[0].parent != folder == first[name].parent:
                continue
            both = f"{first[name].relative_to(folder)} and {group[0].relative_to(folder)}"
            todo = "Name each video after its camera."
            raise InputError(str(folder), "one video of each camera", both, todo)
        found[name] = first[name] = group[0]
        if len(group) > 1:
            if workshop is None or not _is_whole(group):
                raise _chapters_error(folder, group)
            found[name] = workshop / f"{name}{group[0].suffix.lower()}"
            join_videos(group, found[name])
    return found


def without_strays(
    folder: Path, found: Mapping[str, Path], cameras: Collection[str]
) -> dict[str, Path]:
    """Return the videos of cameras; beside videos in a folder, a subfolder's may be anything."""
    is_mixed = bool(_films_in(folder))
    return {
        name: file
        for name, file in found.items()
        if name in cameras or not is_mixed or file.parent.parent != folder
    }


def _films_in(folder: Path) -> list[Path]:
    """Return the videos of a folder by their endings; if none has one, by their content."""
    most = 200  # files whose content is looked at: cameras are fewer
    files = [file for file in sorted(folder.glob("[!.]*")) if not file.is_dir()]
    # With links to a disk that is away, which is told later; without a DVD's menus.
    menu = re.compile(r"VTS_\d\d_0\.VOB|VIDEO_TS\.VOB", re.IGNORECASE)
    named = [file for file in files if is_video(file) and not menu.fullmatch(file.name)]
    if named or len(files) > most:
        return named
    return [file for file in files if file.is_file() and holds_video(file)]


def describe_unused(folder: Path, used: Collection[Path]) -> list[str]:
    """Return sentences about files and videos in a folder that are of no camera."""
    others: list[str] = []
    inner: list[Path] = []
    strays: list[Path] = []
    films = _films_in(folder)
    for place in sorted(folder.glob("[!.]*")):
        if place.is_file() and place not in films:
            others.append(place.name)
        elif place.is_dir() and _has_images(place):
            inner += [each for each in place.glob("[!.]*") if each.suffix.lower() not in SUFFIXES]
        elif place.is_dir() and len(groups := _recordings(_films_in(place))) > 1:
            inner += [group[0] for group in groups if len(group) == 1]
        elif place.is_dir() and [*map(len, groups)] == [1] and groups[0][0] not in used:
            strays += groups[0]
    reasons = {
        "they have no ending of a video": others,
        "a camera's folder has one video, or images": [
            f"{each.parent.name}/{each.name}" for each in sorted(inner)
        ],
        "videos of cameras are beside their folders": [
            f"{each.parent.name}/{each.name}" for each in strays
        ],
    }
    return [f"left out, as {why}: {', '.join(them):.200}" for why, them in reasons.items() if them]


def _has_images(folder: Path) -> bool:
    return any(file.suffix.lower() in SUFFIXES for file in folder.glob("[!.]*"))


def _recordings(files: Sequence[Path]) -> list[list[Path]]:
    """Return the chapters of each recording in order; other videos are alone."""
    found: dict[tuple[str, ...], list[tuple[int, Path]]] = {}
    for file in files:
        *key, number = _chapter(file) or (file.name, 0)
        found.setdefault(tuple(map(str, key)), []).append((int(number), file))
    return [[file for _, file in sorted(group)] for group in found.values()]


def _chapter(file: Path) -> tuple[str, str, str, int] | None:
    """Return what names a chapter's recording, and the chapter's number; None for other videos."""
    chapter = _CHAPTER.fullmatch(file.stem)
    if chapter is None or (chapter[5] is not None) != (file.suffix.lower() == ".vob"):
        return None
    before, kind, number, recording, title, title_number, part = chapter.groups()
    kind = (kind or title or "GP").upper()  # GOPR0017 begins what GP010017 continues
    return before, kind, recording or title_number, int(number or part or 0)


def _is_whole(group: Sequence[Path]) -> bool:
    """Return whether a recording has its first chapter, and those up to its last."""
    chapters = [each for each in map(_chapter, group) if each is not None]
    first = 0 if chapters[0][1] == "GP" else 1
    return [each[3] for each in chapters] == list(range(first, first + len(chapters)))


def _chapters_error(folder: Path, group: Sequence[Path]) -> InputError:
    expected, todo = "all chapters of a recording", "Add the missing chapter."
    if _is_whole(group):
        expected = "one video of each camera"
        todo = "Add --join, which joins them, or join them with ffmpeg: -f concat -safe 0 -i LIST "
        todo += "-c copy OUT.mp4, with a line file 'NAME' for each chapter in LIST."
    found = f"chapters of one recording: {', '.join(file.name for file in group)}"
    return InputError(str(folder), expected, found, todo)


def require_cameras(folder: Path, found: Mapping[str, Path]) -> None:
    """Raise InputError if a folder has the videos of fewer than two cameras."""
    if len(found) < 2:
        there = ", ".join(place.name for place in sorted(folder.glob("[!.]*")))
        expected = f"a video for each of two cameras or more ({', '.join(VIDEO_SUFFIXES)}), or "
        todo = "Name each video after its camera, and put all into the folder itself or each into "
        todo += "a folder of its own."
        raise InputError(str(folder), expected + "a folder of images", there or "no video", todo)


def describe_videos(
    files: Mapping[str, Path], indices: Mapping[str, FrameIndex], clocks: Mapping[str, Integers]
) -> list[str]:
    """Return sentences about what cameras' videos lack.

    A clock (frames,) has the number of the video frame for each of its frames; -1 = missing.
    """
    notes = []
    for name, clock in clocks.items():
        notes += describe_video(files[name], indices[name])
        if gaps := describe_gaps(clock):
            notes.append(f"{name}: {gaps}")
    starts = {n: int(index.stamps[0]) for n, index in indices.items() if index.time_base is None}
    if len(set(starts.values())) > 1:
        least = min(starts.values())
        listed = ", ".join(f"{name} at {one} ({least - one})" for name, one in starts.items())
        said = (
            "count as one moment; if the numbers are of one clock, set offset_frames as bracketed"
        )
        notes.append(f"first images {said}: {listed}")
    counts = {name: len(clock) for name, clock in clocks.items()}
    length = shared_length(counts.values())
    if early := [f"{name} after {count}" for name, count in counts.items() if count < length]:
        notes.append(f"the clip has {length} frames; videos end earlier: {', '.join(early)}")
    if max(counts.values()) > length:
        longest = max(counts, key=lambda name: counts[name])
        notes.append(
            f"the clip ends after {length} frames, the last that two videos show; {longest} has "
            f"{counts[longest]}"
        )
    return notes


def shared_length(counts: Iterable[int]) -> int:
    """Return the number of frames up to the last one that two videos show, or the only one."""
    longest = sorted(counts)[-2:]
    return longest[0] if longest else 0


def describe_gaps(clock: Integers, frame: Integers | None = None) -> str:
    """Return a sentence about the frames that a video lacks; empty if there are none.

    A start or end up to a hundredth of the frames early or late is usual. The clock (frames,) has
    numbers of video frames; -1 = missing. `frame` (frames,) rises and names them; None = from 0.
    """
    shown = np.flatnonzero(clock >= 0)
    if not len(shown):
        return ""
    numbers = np.arange(len(clock)) if frame is None else frame
    between = slice(int(shown[0]), int(shown[-1]))
    gaps = stretches(numbers[between][clock[between] < 0])
    longest = sorted(gaps, key=lambda gap: gap[0] - gap[1])[:5]
    listed = ", ".join(f"{a} to {b}" if a < b else f"{a}" for a, b in sorted(longest))
    count = sum(last - first + 1 for first, last in gaps)
    more = f" and {len(gaps) - len(longest)} more gaps" if len(gaps) > len(longest) else ""
    said = [f"the video lacks {count} of {len(clock)} frames: {listed}{more}"] if gaps else []
    first, last = int(shown[0]), int(shown[-1])
    if len(clock) - (last + 1 - first) > 0.01 * len(clock):
        said.append(
            f"it shows frames {numbers[first]} to {numbers[last]} of {numbers[0]} to {numbers[-1]}"
        )
    return "; ".join(said)


def video_name(camera: str, file: Path) -> str:
    """Return the name of a camera's video in a match folder: its own, if that is the camera's."""
    return file.name if camera_id(file.stem) == camera or file.is_dir() else camera + file.suffix


def copy_videos(files: Mapping[str, Path], folder: Path) -> None:
    """Copy the videos of cameras into a match folder."""
    if files:
        (folder / "videos").mkdir()
    for name, file in files.items():
        target = folder / "videos" / video_name(name, file)
        if file.is_dir():
            target.mkdir()
            for _, image in numbered_images(file):
                shutil.copyfile(image, target / image.name)
        else:
            shutil.copyfile(file, target)


def fit_to_video(
    file: Path,
    camera: CameraCalibration,
    index: FrameIndex,
    notes: list[str],
    *,
    of_sensor: bool,
    has_poses: bool = False,
) -> CameraCalibration:
    """Return a camera in the pixels of its video, which may be resized, or have black bars.

    A change adds a sentence to `notes`. If the calibration is `of_sensor` (`is_of_sensor`), a
    smaller video is its middle part, as in Vicon's video modes; where a resized video has the same
    shape, 2D poses, if `has_poses`, can contradict that. InputError if the video is neither what
    was calibrated nor the same picture resized, or may be the middle part as well as that.
    """
    same_shape = 0.002  # largest relative difference of shapes [1]: sides are whole pixels
    if index.size == camera.image_size:
        return camera
    own, shown = np.array(camera.image_size), np.array(index.size)
    if of_sensor and np.all(shown <= own):
        corner = 0.5 * (own - shown)
        part = f"the middle {index.size[0]} x {index.size[1]} px of the sensor"
        warning = ""
        if np.ptp(shown / own) <= same_shape:
            part += ", or the whole one resized to it"
            x, y = corner
            todo = "Give videos of the sensor's size, resized if they show all of it. If they are "
            todo += "its middle, write the calibration of that part: set SENSOR_SIZE, and subtract "
            todo += f"{x:g}, {y:g} from PRINCIPAL_POINT and the centre of VICON_RADIAL2."
            if not has_poses:
                expected = "{} x {} px, SENSOR_SIZE in the calibration".format(*camera.image_size)
                raise InputError(str(file), expected, part, todo)
            warning, part = "warning: ", f"{part}; taken as the middle. If no people agree: {todo}"
        notes.append(f"{warning}{file.name}: {part}")
        middle = np.array(camera.principal_point_px) - corner
        return camera.model_copy(
            update={"image_size": index.size, "principal_point_px": tuple(middle.tolist())}
        )
    scale = float((shown / own).min())
    bar = 0.5 * (shown - scale * own)
    if (shown / own).max() > (1.0 + same_shape) * scale:
        with open_video(file, index) as video:
            if not _has_black_bars(video.frame(0), bar):
                expected = "{} x {} px, the size in the calibration".format(*camera.image_size)
                todo = "Give the video that was calibrated, in its size: a crop has another "
                todo += "principal point, and a turned one another calibration."
                raise InputError(str(file), expected, "{} x {}".format(*index.size), todo)
    notes.append(
        f"{file.name}: {index.size[0]} x {index.size[1]} px, calibrated are {{}} x {{}}: ".format(
            *camera.image_size
        )
        + f"the calibration is scaled by {scale:.5f}"
        + (f", with black bars of {bar.max():.1f} px" if bar.max() > 1.0 else "")
    )
    return scaled(camera, scale, index.size, bar)


def _has_black_bars(frame: Image, bar: NDArray[np.float64]) -> bool:
    """Return whether a frame has black bars of a width on both sides of one axis, and no wider.

    Their width is given along x and y [px], with a fraction.
    """
    max_black = 16.0  # mean brightness of a bar [1, of 255]: black of limited-range video
    axis = int(bar.argmax())
    width = int(bar[axis])
    lines = frame.mean(axis=(axis, 2)).astype(np.float64)
    black = np.concatenate([lines[:width], lines[len(lines) - width :]])
    # The line next to a bar with a fraction is a mixture.
    next_lines = [lines[width + 2], lines[-width - 3]]
    return width > 0 and bool(black.max() < max_black and min(next_lines) > max_black)
