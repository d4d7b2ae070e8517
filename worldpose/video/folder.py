"""Folders of numbered images, with the interface of videos."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.video.frame_index import FrameIndex, index_frames
from worldpose.video.images import decode_image
from worldpose.video.reading import VideoReader

SUFFIXES: Final = (".png", ".jpg", ".jpeg")
_DIGITS: Final = 18
"""Most digits of an image's number: 64 bits hold no longer one."""


class ImageFolder:
    """Images whose names end in their number; the lowest is frame 0, a gap a missing frame."""

    def __init__(self, folder: Path, index: FrameIndex | None = None) -> None:
        """Open a folder.

        Args:
            folder: holds the images.
            index: of the images, if known; else it is computed.

        Raises:
            InputError: no images, or names without a number or with the same one.
        """
        self.path = folder
        self._files = [file for _, file in numbered_images(folder)]
        self.index = index_images(folder) if index is None else index

    def __enter__(self) -> ImageFolder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._files)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return one image (height, width, 3) RGB.

        Raises:
            InputError: the file is no image.
        """
        return next(self.frames(number, number + 1))[1]

    def frames(
        self, start: int = 0, stop: int | None = None, *, grey: bool = False
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield image numbers from `start` up to before `stop`, each with its image.

        Args:
            start: first image, in the order of the numbers.
            stop: one past the last; all if None.
            grey: (height, width) instead of RGB.

        Raises:
            InputError: a file is no image.
        """
        for number, picture in self.readable(start, stop, grey=grey):
            if picture is None:
                raise InputError(
                    str(self._files[number]),
                    expected="a PNG or JPEG picture",
                    found="none",
                    todo="Write it anew.",
                )
            yield number, picture

    def readable(
        self, start: int = 0, stop: int | None = None, *, grey: bool = False
    ) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        """Yield image numbers from `start` up to before `stop` and images; None if unreadable.

        Args:
            start: first image, in the order of the numbers.
            stop: one past the last; all if None.
            grey: (height, width) instead of RGB.
        """
        for number in range(start, len(self) if stop is None else stop):
            yield number, _read(self._files[number], grey=grey)


def numbered_images(folder: Path) -> list[tuple[int, Path]]:
    """Return the images of a folder by the number at the end of their names.

    Raises:
        InputError: no images, or names without a number or with the same one.
    """
    files = sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
    )
    ends = [re.search(r"\d+$", file.stem) for file in files]
    too_long = next((end.group() for end in ends if end and len(end.group()) > _DIGITS), None)
    if too_long is not None:
        raise InputError(
            str(folder),
            expected=f"images whose names end in numbers of at most {_DIGITS} digits",
            found=too_long,
            todo="Name them in order, for example 000123.jpg.",
        )
    numbers = [int(end.group()) for end in ends if end]
    if not files or len(set(numbers)) < len(files):
        raise InputError(
            str(folder),
            expected=f"images ({', '.join(SUFFIXES)}) whose names end in numbers that differ",
            found=f"{len(files)} images with {len(set(numbers))} numbers",
            todo="Name them in order, for example 000123.jpg.",
        )
    return sorted(zip(numbers, files, strict=True))


def index_images(folder: Path) -> FrameIndex:
    """Return the index of a folder of images; the size comes from the first one.

    Raises:
        InputError: no images, or names without a number or with the same one.
    """
    images = numbered_images(folder)
    stamps = np.array([number for number, _ in images], dtype=np.int64)
    first = _read(images[0][1], grey=True)
    if first is None:
        raise InputError(
            str(images[0][1]), expected="a picture", found="none", todo="Write it again."
        )
    return FrameIndex(stamps, np.ones(len(stamps), dtype=np.bool_), None, first.shape[::-1])


def index_video(path: Path) -> FrameIndex:
    """Return the index of a video file or of a folder of images.

    Raises:
        InputError: neither.
    """
    return index_images(path) if path.is_dir() else index_frames(path)


def open_video(path: Path, index: FrameIndex | None = None) -> VideoReader | ImageFolder:
    """Open a video file or a folder of images, to be read by frame number."""
    return ImageFolder(path, index) if path.is_dir() else VideoReader(path, index)


def _read(file: Path, *, grey: bool) -> NDArray[np.uint8] | None:
    """Return an image as displayed, RGB or grey; None if the file is no image."""
    return decode_image(np.fromfile(file, dtype=np.uint8), grey=grey)
