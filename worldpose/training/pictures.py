"""Images read once and cached in bounded memory."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Return an image (height, width, 3) in RGB.

    Raises:
        InputError: the file is no readable image.
    """
    data = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if data is None:
        raise InputError(
            str(path),
            expected="a picture",
            found="none that can be read",
            todo="Put the data set's pictures where its annotations say.",
        )
    return np.ascontiguousarray(np.asarray(data, dtype=np.uint8)[..., ::-1])


class PictureCache:
    """Images by path, in a cache that evicts the least recently used.

    Args:
        most: largest size of the cache [byte].
    """

    def __init__(self, most: int = 3 << 30) -> None:
        self._most, self._size = most, 0
        self._kept: OrderedDict[Path, NDArray[np.uint8]] = OrderedDict()

    def __getitem__(self, path: Path) -> NDArray[np.uint8]:
        if path in self._kept:
            self._kept.move_to_end(path)
            return self._kept[path]
        picture = read_picture(path)
        self._kept[path] = picture
        self._size += picture.nbytes
        while self._size > self._most and len(self._kept) > 1:
            _, gone = self._kept.popitem(last=False)
            self._size -= gone.nbytes
        return picture
