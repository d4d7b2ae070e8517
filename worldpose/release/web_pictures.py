"""Pictures as small as a page needs them."""

from __future__ import annotations

from typing import Final

import numpy as np

LARGE: Final = 200_000
"""Bytes of a PNG from which it holds a photograph, and not curves."""
QUALITY: Final = 88
"""Of WebP, at which lines a pixel wide stay sharp."""


def small_enough(png: bytes) -> tuple[str, bytes, tuple[int, int]]:
    """Return kind, content and size (width, height) [px] of a picture: WebP where that is smaller.

    Args:
        png: a PNG.
    """
    size = (int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big"))
    if len(png) < LARGE:
        return "png", png, size
    import cv2  # late: pages without large pictures need none of it

    picture = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    _, webp = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return ("webp", webp.tobytes(), size) if webp.size < len(png) else ("png", png, size)
