"""Shadows of people and things on the grass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Singles
from worldpose.compiled import compiled
from worldpose.geometry import Camera
from worldpose.geometry.rasters import Box, cover_triangles
from worldpose.simulation.outlines import outline_shadows
from worldpose.simulation.venues import Venue

Bytes = NDArray[np.uint8]
Faces = NDArray[np.int32]

SKY: Final = np.array([0.0, 0.0, -1.0, 0.2])
"""Ambient light, as a light straight from above: dims the grass at the feet."""
SOFT: Final = 0.9
"""Standard deviation of a shadow's rim [px]: some centimetres."""
_MARGIN: Final = 3
"""Margin around a shadow, the extent of its rim [px]."""


def shade_ground(
    venue: Venue, camera: Camera, picture: Bytes, things: Sequence[tuple[Faces, Singles]]
) -> list[Box]:
    """Darken the grass in shadows, and return the boxes that changed.

    Args:
        venue: the stadium and its lights.
        camera: a single camera.
        picture: (height, width, 3), changed in place.
        things: faces (triangles, 3) and vertices (things, vertices, 3) [m], world, of objects that
            cast shadows.
    """
    height, width = picture.shape[:2]
    mask = np.zeros((height, width), dtype=np.uint8)
    # Levels of 255 that each combination of lights takes.
    taken = np.zeros(256, dtype=np.uint8)
    boxes: list[Box] = []
    for index, light in enumerate((*venue.lights, SKY)):
        bit = 1 << index
        taken[[value for value in range(256) if value & bit]] += round(255.0 * float(light[3]))
        for faces, vertices in things:
            shadows = outline_shadows(venue, camera, vertices, light)
            for number in range(len(vertices)):
                box = shadows.box(number, _MARGIN, width, height)
                if box is not None:
                    cover_triangles(shadows.pixels[number], faces, bit, mask)
                    boxes.append(box)
    dark = np.zeros((height, width), dtype=np.uint8)
    for left, top, right, bottom in boxes:
        part = (slice(top, bottom), slice(left, right))
        soft = cv2.GaussianBlur(taken[mask[part]], (0, 0), SOFT)
        # Where boxes overlap, both have the whole shadow.
        np.maximum(dark[part], soft, out=dark[part])
    for left, top, right, bottom in boxes:
        part = (slice(top, bottom), slice(left, right))
        _darken(picture[part], dark[part])
    return boxes


@compiled
def _darken(picture: Bytes, dark: Bytes) -> None:
    """Subtract a share (height, width) [1/255] from an image, and reset the share to zero."""
    for v in range(picture.shape[0]):
        for u in range(picture.shape[1]):
            left = 255 - int(dark[v, u])
            if left == 255:
                continue
            for k in range(3):
                picture[v, u, k] = (int(picture[v, u, k]) * left + 127) // 255
            dark[v, u] = 0
