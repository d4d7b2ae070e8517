"""People's surfaces and their shadows in a picture: every vertex through the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.cameras import Camera
from worldpose.cameras.projection import project_point
from worldpose.cameras.rays import RayStatus
from worldpose.compiled import compiled
from worldpose.synthetic.venues import Venue

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Box = tuple[int, int, int, int]

_OK = int(RayStatus.OK)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Where people, or their shadows, are in a picture.

    Attributes:
        pixels: (persons, vertices, 3) pixel [px] and depth [m]; NaN without an image.
        boxes: (persons, 4) left, top, right, bottom of all vertices with an image [px].
    """

    pixels: Singles
    boxes: Floats

    def box(self, person: int, margin: int, width: int, height: int) -> Box | None:
        """Return the part of the picture with somebody in it: left, top, right, bottom."""
        if not np.isfinite(self.boxes[person]).all():
            return None
        left, top, right, bottom = self.boxes[person]
        part = (
            max(int(np.floor(left)) - margin, 0),
            max(int(np.floor(top)) - margin, 0),
            min(int(np.ceil(right)) + margin + 1, width),
            min(int(np.ceil(bottom)) + margin + 1, height),
        )
        return part if part[0] < part[2] and part[1] < part[3] else None


def outline_people(camera: Camera, vertices: Singles) -> Outlines:
    """Return outlines of surfaces (persons, vertices, 3) [m], world."""
    pixels, boxes = np.empty_like(vertices), np.empty((len(vertices), 4))
    _project(camera.numbers, vertices, pixels, boxes)
    return Outlines(pixels, boxes)


def outline_shadows(venue: Venue, camera: Camera, vertices: Singles, light: Floats) -> Outlines:
    """Return outlines of the shadows that surfaces throw on the grass.

    A vertex has no shadow beyond the boards, or where the stand keeps this light off anyway; it
    keeps none off that comes straight down.

    Args:
        venue: the stadium.
        camera: a single camera.
        vertices: (persons, vertices, 3) [m], world.
        light: (4,) direction down from the light, z = -1, and its share of all light.
    """
    straight_down = not light[:2].any()
    edge = venue.edge if venue.shade > 0.0 and not straight_down else np.inf
    fallen, pixels = np.empty_like(vertices), np.empty_like(vertices)
    boxes = np.empty((len(vertices), 4))
    ground = np.array([venue.bend, *venue.half, venue.side, edge])
    _throw(vertices, light, ground, fallen)
    _project(camera.numbers, fallen, pixels, boxes)
    return Outlines(pixels, boxes)


@compiled
def _project(camera: Floats, vertices: Singles, pixels: Singles, boxes: Floats) -> None:
    """Write pixels and depth (persons, vertices, 3), and the box (4,) around each person."""
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


@compiled
def _throw(vertices: Singles, light: Floats, ground: Floats, fallen: Singles) -> None:
    """Write where light through vertices meets the grass; NaN where nothing is darkened.

    Args:
        vertices: (persons, vertices, 3) [m], world.
        light: (4,), its direction down first.
        ground: the bend of the surface, half the distances between the boards along x and y, the
            side of the stand that throws a shadow, and where this begins.
        fallen: (persons, vertices, 3), written.
    """
    for p in range(vertices.shape[0]):
        for v in range(vertices.shape[1]):
            x, y, z = vertices[p, v, 0], vertices[p, v, 1], vertices[p, v, 2]
            up = max(z + ground[0] * y * y, 0.0)
            gx, gy = x + up * light[0], y + up * light[1]
            if not (abs(gx) < ground[1] and abs(gy) < ground[2] and ground[3] * gy < ground[4]):
                fallen[p, v] = np.nan
                continue
            fallen[p, v, 0], fallen[p, v, 1] = gx, gy
            fallen[p, v, 2] = -ground[0] * gy * gy
