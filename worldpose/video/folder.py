"""Folders of numbered images, with the interface of videos, and selected frames of either.

Images are decoded in memory, after a check of the size in their header.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Image, Integers
from worldpose.errors import InputError
from worldpose.video.files import VideoReader, index_frames
from worldpose.video.names import frame_numbers
from worldpose.video.pictures import FrameIndex, Pictures
from worldpose.video.recordings import read_dpx

MAX_PIXELS: Final = 200_000_000
"""No camera takes larger images; a few hundred bytes can declare gigabytes."""


def decode_image(content: Image, *, grey: bool = False, turned: bool = True) -> Image | None:
    """Return an image (height, width, 3) RGB, or (height, width) grey, of a file of `FORMATS`.

    It is `turned` as its EXIF tag says that it is shown, or as it is stored. None if the content
    (bytes,) is no whole image, or declares more than `MAX_PIXELS`.
    """
    import cv2  # late: it takes 0.2 s, and few commands open an image

    width, height = declared_size(content) or (0, 0)
    if not 0 < width * height <= MAX_PIXELS:
        return None
    form = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR_RGB
    try:
        image = cv2.imdecode(content, form | (0 if turned else cv2.IMREAD_IGNORE_ORIENTATION))
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image, dtype=np.uint8)


def declared_size(content: Image) -> tuple[int, int] | None:
    """Return width and height [px], as displayed, in the header of an image; None for other files.

    An image that its EXIF tag turns by a quarter is shown with its sides exchanged.
    """
    from PIL import Image as Pillow  # late: few commands open an image

    orientation_tag = 0x0112  # of EXIF: the way in which an image is shown
    try:
        with Pillow.open(io.BytesIO(content.tobytes()), formats=FORMATS) as image:
            width, height = image.size
            turned = image.getexif().get(orientation_tag) in (5, 6, 7, 8)
    except Exception:  # Pillow documents no closed list for damaged files
        return None
    return (height, width) if turned else (width, height)


FORMATS: Final = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
"""Pillow's names of the kinds of images that are read."""
SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".dpx")


class ImageFolder(Pictures):
    """Images whose names have their number; the lowest is frame 0, a gap a missing frame."""

    def __init__(self, folder: Path, index: FrameIndex | None = None) -> None:
        """Open a folder of images, with its index or one of `index_images`."""
        self.path = folder
        self._files = [file for _, file in numbered_images(folder)]
        self.index = index_images(folder) if index is None else index

    def readable(
        self,
        start: int = 0,
        stop: int | None = None,
        *,
        grey: bool = False,
        only: Collection[int] | None = None,
    ) -> Iterator[tuple[int, Image | None]]:
        """Yield images as `frames` does, with None for each unreadable one; see `VideoReader`."""
        for number in range(start, len(self) if stop is None else stop):
            if only is None or number in only:
                picture = _read(self._files[number], grey=grey)
                if picture is not None and picture.shape[1::-1] != self.index.size:
                    raise InputError(
                        str(self._files[number]),
                        expected="images of {} x {} px, as the first one".format(*self.index.size),
                        found=f"{picture.shape[1]} x {picture.shape[0]}",
                        todo="Keep the images of one camera and one mode in a folder.",
                    )
                yield number, picture

    def damage_error(self, number: int) -> InputError:
        """Return the error of a file that is no image."""
        return InputError(str(self._files[number]), "a picture", "none", "Write it again.")


def numbered_images(folder: Path) -> list[tuple[int, Path]]:
    """Return the images of a folder by the numbers at the ends of their names, or else in these.

    `frame_numbers` finds the latter, as in `img (7).png` of Windows. InputError for no images, or
    names without a number or with the same one.
    """
    files = sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
    )
    ends = [end for file in files if (end := re.fullmatch(r"(.*\D|)(\d{1,18})", file.stem))]
    if len(ends) == len(files) and len({end[1] for end in ends}) == 1:
        numbers = {file.name: int(end[2]) for file, end in zip(files, ends, strict=True)}
    else:
        numbers = frame_numbers((file.name for file in files), ends=True)
    if not files or len(set(numbers.values())) < len(files):
        raise InputError(
            str(folder),
            expected=f"images ({', '.join(SUFFIXES)}) of one clip, whose names number them",
            found=f"{len(files)} images with {len(set(numbers.values()))} numbers",
            todo="Name them in order, for example 000123.jpg.",
        )
    return sorted((numbers[file.name], file) for file in files)


def index_images(folder: Path) -> FrameIndex:
    """Return the index of a folder as of `numbered_images`; the size comes from the first one."""
    images = numbered_images(folder)
    stamps = np.array([number for number, _ in images], dtype=np.int64)
    first = _read(images[0][1], grey=True)
    if first is None:
        raise InputError(
            str(images[0][1]), expected="a picture", found="none", todo="Write it again."
        )
    return FrameIndex(stamps, np.ones(len(stamps), dtype=np.bool_), None, first.shape[::-1])


def index_video(path: Path) -> FrameIndex:
    """Return the index of a video file or of a folder of images; InputError if it is neither."""
    return index_images(path) if path.is_dir() else index_frames(path)


def open_video(
    path: str | os.PathLike[str], index: FrameIndex | None = None
) -> VideoReader | ImageFolder:
    """Open a video file or a folder of images, to be read by frame number."""
    path = Path(path)
    return ImageFolder(path, index) if path.is_dir() else VideoReader(path, index)


def _read(file: Path, *, grey: bool) -> Image | None:
    """Return an image as displayed, RGB or grey; None if the file is no image."""
    if file.suffix.lower() == ".dpx":
        return read_dpx(file, grey=grey)
    return decode_image(np.fromfile(file, dtype=np.uint8), grey=grey)


def some_pictures(
    video: VideoReader | ImageFolder, numbers: NDArray[np.integer]
) -> Iterator[tuple[int, Image | None]]:
    """Yield frames of rising numbers (pictures,); None where one cannot be decoded."""
    for group in jumps(numbers, video.index.key):
        only = set(group.tolist())
        yield from video.readable(int(group[0]), int(group[-1]) + 1, only=only)


def pictures_at(
    video: VideoReader | ImageFolder, numbers: NDArray[np.integer], *, grey: bool = False
) -> Iterator[Image | None]:
    """Yield the frame of each number as `readable_at` does; InputError if one is damaged."""
    shown = readable_at(video, numbers, grey=grey)
    for number, picture in zip(numbers.tolist(), shown, strict=True):
        if picture is None and number >= 0:
            raise video.damage_error(number)
        yield picture


def readable_at(
    video: VideoReader | ImageFolder, numbers: NDArray[np.integer], *, grey: bool = False
) -> Iterator[Image | None]:
    """Yield the frame of each number; None for a negative one, and where none can be decoded.

    Numbers (pictures,) may repeat; decoding begins again where they go back. Grey is as of
    `Pictures.frames`.
    """
    only = set(numbers.tolist())
    end = max(only, default=0) + 1
    at, picture = end, cast("Image | None", None)
    for number in numbers.tolist():
        if 0 <= number < at:
            at, shown = -1, video.readable(number, end, grey=grey, only=only)
        while at < number:
            at, picture = next(shown)
        yield picture if number >= 0 else None


def grey_on_clock(path: Path, numbers: Integers, fps: float) -> Iterator[Image]:
    """Yield the grey image of each number of a camera's clock; black where the video has none."""
    with open_video(path) as video:
        black = np.zeros(video.index.size[::-1], dtype=np.uint8)
        shown = video.index.shown(numbers, fps, str(path))
        for picture in pictures_at(video, shown, grey=True):
            yield black if picture is None else picture


def jumps(numbers: NDArray[np.integer], key: Flags) -> list[NDArray[np.integer]]:
    """Return groups of frames, each decoded in one pass.

    Selected numbers (pictures,) rise; at `key` (all pictures,) decoding can begin.
    """
    if not len(numbers):
        return []
    keys = np.flatnonzero(key)
    begin = keys[np.maximum(np.searchsorted(keys, numbers, side="right") - 1, 0)]
    saved = begin[1:] - numbers[:-1] - 1
    # A restart costs about as many frames.
    return np.split(numbers, np.flatnonzero(saved >= 8) + 1)


def median_picture(frames: Iterable[Image], most: int = 64) -> Image:
    """Return the median of a clip's frames, which shows no moving people.

    At most `most` frames, two or more, are in memory, evenly spread over the clip: when the limit
    is reached, the function drops every second frame and doubles the stride. Frames of a camera
    that does not move are (height, width) or (height, width, 3). InputError for none, or other
    sizes.
    """
    band = 64  # rows, which stay in the processor's cache
    if most < 2:
        todo = "Give for example 64."
        raise InputError("median_picture: most", "two frames or more", f"{most}", todo)
    kept: list[Image] = []
    stride = 1
    for index, frame in enumerate(frames):
        if kept and frame.shape != kept[0].shape:
            raise _sizes(f"{kept[0].shape} and, in frame {index}, {frame.shape}")
        if index % stride:
            continue
        if len(kept) == most:
            kept, stride = kept[::2], 2 * stride
            if index % stride:
                continue
        kept.append(frame.copy())  # readers may fill the same buffer again
    if not kept:
        raise _sizes("no frames")
    median = np.empty_like(kept[0])
    for top in range(0, len(median), band):
        median[top : top + band] = _median_level([frame[top : top + band] for frame in kept])
    return median


def _median_level(pictures: Sequence[Image]) -> Image:
    """Return the lower of the two middle levels of every pixel, bit by bit from the highest.

    It is the largest level that at most half of the pictures lie below. Comparing whole pictures
    takes a tenth of the time of sorting the levels of each pixel.
    """
    middle = (len(pictures) - 1) // 2
    median = np.zeros_like(pictures[0])
    for bit in (128, 64, 32, 16, 8, 4, 2, 1):
        trial = median | np.uint8(bit)
        below = np.zeros(trial.shape, np.uint8 if len(pictures) < 256 else np.uint16)
        for picture in pictures:
            below += picture < trial
        np.copyto(median, trial, where=below <= middle)
    return median


def _sizes(found: str) -> InputError:
    todo = "Give frames of one camera's clip."
    return InputError("median_picture", "one or more frames of one size", found, todo)
