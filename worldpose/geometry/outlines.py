"""Projection of surface vertices into an image, through the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats, Singles
from worldpose.compiled import compiled
from worldpose.geometry.pinhole import Camera
from worldpose.geometry.projection import project_point
from worldpose.geometry.rays import RayStatus

Box = tuple[int, int, int, int]

_OK = int(RayStatus.OK)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Image positions of surfaces.

    Attributes:
        pixels: (surfaces, vertices, 3) pixel [px] and depth [m]; NaN without an image.
        boxes: (surfaces, 4) left, top, right, bottom of all vertices with an image [px].
    """

    pixels: Singles
    boxes: Floats

    def box(self, number: int, margin: int, width: int, height: int) -> Box | None:
        """Return the part of the image that shows a surface: left, top, right, bottom."""
        if not np.isfinite(self.boxes[number]).all():
            return None
        left, top, right, bottom = self.boxes[number]
        part = (
            max(int(np.floor(left)) - margin, 0),
            max(int(np.floor(top)) - margin, 0),
            min(int(np.ceil(right)) + margin + 1, width),
            min(int(np.ceil(bottom)) + margin + 1, height),
        )
        return part if part[0] < part[2] and part[1] < part[3] else None


def outline_surfaces(camera: Camera, vertices: Singles) -> Outlines:
    """Return outlines in a single camera's image of (surfaces, vertices, 3) [m], world."""
    pixels, boxes = np.empty_like(vertices), np.empty((len(vertices), 4))
    _project(camera.numbers, vertices, pixels, boxes)
    return Outlines(pixels, boxes)


@compiled
def _project(camera: Floats, vertices: Singles, pixels: Singles, boxes: Floats) -> None:
    """Write pixels and depth (surfaces, vertices, 3), and the box (4,) around each surface."""
    for p in range(vertices.shape[0]):
        left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
        for v in range(vertices.shape[1]):
            at = vertices[p, v]
            seen = project_point(camera, float(at[0]), float(at[1]), float(at[2]))
            if seen[0] != _OK:
                pixels[p, v] = np.nan
                continue
            x, y = camera[0] * seen[1] + camera[2], camera[1] * seen[2] + camera[3]
            pixels[p, v, 0], pixels[p, v, 1], pixels[p, v, 2] = x, y, seen[5]
            left, right = min(left, x), max(right, x)
            top, bottom = min(top, y), max(bottom, y)
        boxes[p, 0], boxes[p, 1], boxes[p, 2], boxes[p, 3] = left, top, right, bottom
        if not left < np.inf:
            boxes[p] = np.nan
