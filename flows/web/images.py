"""Images as responses of the pages."""

from __future__ import annotations

import os
from pathlib import Path

from fastapi.responses import Response

from data_contracts.arrays import Image


def file_mark(file: Path) -> tuple[str, int, int]:
    """Return a path, its size [byte] and the time of its last change [ns].

    Of a folder, also those of its files: writing one anew does not change the folder's own.
    """
    states = [file.stat()]
    if file.is_dir():
        with os.scandir(file) as entries:
            states += [entry.stat() for entry in entries if entry.is_file()]
    size, changed = zip(*((each.st_size, each.st_mtime_ns) for each in states), strict=True)
    return str(file), sum(size), max(changed)


def encode_image(image: Image, kind: str) -> bytes:
    """Return an image (height, width, 3) RGB as `png` or `jpeg`."""
    import cv2  # imported here: few pages decode an image

    return bytes(cv2.imencode(f".{kind}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1])


def image_response(image: Image, kind: str) -> Response:
    """Return the response with an image (height, width, 3) RGB as `png` or `jpeg`."""
    return Response(encode_image(image, kind), media_type=f"image/{kind}")
