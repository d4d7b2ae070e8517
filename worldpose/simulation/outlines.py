"""Outlines of shadows on the grass, in the image of a camera."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats, Singles
from worldpose.compiled import compiled
from worldpose.geometry import Camera
from worldpose.geometry.rasters import Outlines, outline_surfaces
from worldpose.simulation.venues import Venue


def outline_shadows(venue: Venue, camera: Camera, vertices: Singles, light: Floats) -> Outlines:
    """Return outlines of the shadows that surfaces cast on the grass.

    A vertex casts no shadow beyond the boards, or where the stand's shadow already covers the
    grass; the stand does not block light that comes straight down.

    Args:
        venue: the stadium.
        camera: a single camera.
        vertices: (persons, vertices, 3) [m], world.
        light: (4,) direction down from the light, z = -1, and its share of all light.
    """
    straight_down = not light[:2].any()
    edge = venue.edge if venue.shade > 0.0 and not straight_down else np.inf
    fallen = np.empty_like(vertices)
    ground = np.array([venue.bend, *venue.half, venue.side, edge])
    _throw(vertices, light, ground, fallen)
    return outline_surfaces(camera, fallen)


@compiled
def _throw(vertices: Singles, light: Floats, ground: Floats, fallen: Singles) -> None:
    """Write the grass points in the shadows of vertices; NaN where none is darkened.

    Args:
        vertices: (persons, vertices, 3) [m], world.
        light: (4,), its direction down first.
        ground: the bend of the surface, half the distances between the boards along x and y, the
            side of the stand that casts a shadow, and the start of that shadow.
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
