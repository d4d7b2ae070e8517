"""Images as responses of the pages."""

from __future__ import annotations

from pathlib import Path

from fastapi.responses import Response

from data_contracts.arrays import Image


def file_mark(file: Path) -> tuple[str, int, int]:
    """Return a file's path, size [byte] and time of its last change [ns]; of another, others."""
    status = file.stat()
    return str(file), status.st_size, status.st_mtime_ns


def encode_image(image: Image, kind: str) -> bytes:
    """Return an image (height, width, 3) RGB as `png` or `jpeg`."""
    import cv2  # imported here: few pages decode an image

    return bytes(cv2.imencode(f".{kind}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1])


def image_response(image: Image, kind: str) -> Response:
    """Return the response with an image (height, width, 3) RGB as `png` or `jpeg`."""
    return Response(encode_image(image, kind), media_type=f"image/{kind}")
