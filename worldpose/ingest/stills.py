"""Reader and writer of stills: one image of a static camera, as PNG (JPEG is read too)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.ingest.text_files import require_file
from worldpose.video.images import declared_size, decode_image

STILL_BYTES = 1 << 28
"""Maximum size of a still [byte]; a noisy 4K image has 25 MB."""


def read_still(path: Path, image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the image (height, width, 3), RGB.

    Args:
        path: a PNG file.
        image_size: width and height of the camera [px].

    Raises:
        InputError: no such file, no image, or another image size.
    """
    size = require_file(path)
    content = np.fromfile(path, dtype=np.uint8) if size <= STILL_BYTES else np.empty(0, np.uint8)
    declared = declared_size(content)
    if declared is not None and declared != image_size:
        raise InputError(
            str(path),
            expected=f"{image_size[0]} x {image_size[1]} px, the size in match.yaml",
            found=f"{declared[0]} x {declared[1]}",
            todo="Export the still at the size of the video, or correct match.yaml.",
        )
    image = decode_image(content)
    if image is None:
        raise InputError(
            str(path),
            expected=f"a PNG image of at most {STILL_BYTES} bytes",
            found=f"{size} bytes that are none",
            todo="Export the still again.",
        )
    return image


def write_still(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an image (height, width, 3), RGB, as PNG; equal images give equal bytes."""
    import cv2  # late: it takes a fifth of a second, and few commands open an image

    path.parent.mkdir(parents=True, exist_ok=True)
    _, content = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    path.write_bytes(content.tobytes())
