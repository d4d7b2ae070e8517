"""Decoding of PNG and JPEG images in memory, after a check of the size in their header."""

from __future__ import annotations

import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

HEADER_BYTES: Final = 1 << 20
"""First bytes of a file that must hold its image's size [byte]; camera metadata may precede it."""
MAX_PIXELS: Final = 200_000_000
"""No camera takes larger images; a few hundred bytes can declare gigabytes."""


def decode_image(content: NDArray[np.uint8], *, grey: bool = False) -> NDArray[np.uint8] | None:
    """Return an image (height, width, 3) RGB, or (height, width) grey.

    Args:
        content: (bytes,) of a PNG or JPEG file.
        grey: without colour.

    Returns:
        None if the bytes are no whole image, or declare more than `MAX_PIXELS`.
    """
    import cv2  # late: it takes a fifth of a second, and few commands open an image

    width, height = declared_size(content) or (0, 0)
    if not 0 < width * height <= MAX_PIXELS:
        return None
    try:
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR_RGB)
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image, dtype=np.uint8)


def declared_size(content: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Return width and height [px] in the header of a PNG or JPEG file; None for other files."""
    header = content[:HEADER_BYTES].tobytes()
    if header[:8] == b"\x89PNG\r\n\x1a\n" and header[12:16] == b"IHDR" and len(header) >= 24:
        width, height = struct.unpack(">II", header[16:24])
        return width, height
    place = 2 if header[:2] == b"\xff\xd8" else len(header)
    while place + 9 <= len(header) and header[place] == 0xFF:
        marker, length = struct.unpack(">BH", header[place + 1 : place + 4])
        if marker == 0xFF:  # padding before a marker
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame
            height, width = struct.unpack(">HH", header[place + 5 : place + 9])
            return width, height
        else:
            place += 2 + length
    return None
