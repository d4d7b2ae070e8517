"""Selected frames of a video, without decoding all between them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.video.folder import ImageFolder
from worldpose.video.reading import VideoReader

WORTH: Final = 8
"""Frames that a jump to a key frame must save: a restart costs about as many."""


def some_pictures(
    video: VideoReader | ImageFolder, numbers: NDArray[np.integer]
) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Yield selected frames in order; None where one cannot be decoded.

    Args:
        video: their source.
        numbers: (pictures,) rising.
    """
    for group in jumps(numbers, video.index.key):
        wanted = set(group.tolist())
        for number, picture in video.readable(int(group[0]), int(group[-1]) + 1):
            if number in wanted:
                yield number, picture


def jumps(numbers: NDArray[np.integer], key: NDArray[np.bool_]) -> list[NDArray[np.integer]]:
    """Return groups of frames, each decoded in one pass.

    Args:
        numbers: (pictures,) selected, rising.
        key: (all pictures,) whether decoding can begin there.
    """
    if not len(numbers):
        return []
    keys = np.flatnonzero(key)
    begin = keys[np.maximum(np.searchsorted(keys, numbers, side="right") - 1, 0)]
    saved = begin[1:] - numbers[:-1] - 1
    return np.split(numbers, np.flatnonzero(saved >= WORTH) + 1)
