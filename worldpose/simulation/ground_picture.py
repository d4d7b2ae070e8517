"""Image of the scene without people: each pixel cast back to the surface that it sees."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.compiled import compiled
from worldpose.geometry import Camera
from worldpose.simulation.surroundings import BOARD_HEIGHT, scenery
from worldpose.simulation.turf import grass, paint_cover, surface_hit, wear

Pictures = NDArray[np.float32]

_CELL: Final = 4
"""Grid spacing of the lens inversion [px]: between the nodes, straight lines have errors of k1 /
focal length of a pixel, a few ten-thousandths."""


def plane_grid(camera: Camera, width: int, height: int) -> Floats:
    """Return undistorted coordinates (rows, columns, 2) of every fourth pixel, from (-4, -4)."""
    u = np.arange(-_CELL, width + 2 * _CELL, _CELL, dtype=np.float64)
    v = np.arange(-_CELL, height + 2 * _CELL, _CELL, dtype=np.float64)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    return camera.normalize(pixels.reshape(-1, 2)).reshape(*pixels.shape)


@compiled
def _looked(grid: Floats, u: float, v: float) -> tuple[float, float, float, float, float, float]:
    """Return undistorted coordinates at a pixel, and their changes to the right and down."""
    gu, gv = u / _CELL + 1.0, v / _CELL + 1.0
    i, j = int(gu), int(gv)
    fu, fv = gu - i, gv - j
    ax, ay, bx, by = grid[j, i, 0], grid[j, i, 1], grid[j, i + 1, 0], grid[j, i + 1, 1]
    cx, cy = grid[j + 1, i, 0], grid[j + 1, i, 1]
    dx, dy = grid[j + 1, i + 1, 0], grid[j + 1, i + 1, 1]
    x = (1 - fv) * ((1 - fu) * ax + fu * bx) + fv * ((1 - fu) * cx + fu * dx)
    y = (1 - fv) * ((1 - fu) * ay + fu * by) + fv * ((1 - fu) * cy + fu * dy)
    xu = ((1 - fv) * (bx - ax) + fv * (dx - cx)) / _CELL
    yu = ((1 - fv) * (by - ay) + fv * (dy - cy)) / _CELL
    xv = ((1 - fu) * (cx - ax) + fu * (dx - bx)) / _CELL
    yv = ((1 - fu) * (cy - ay) + fu * (dy - by)) / _CELL
    return x, y, xu, yu, xv, yv


@compiled
def paint_scene(
    grid: Floats,
    o: Floats,
    r: Floats,
    paint: Floats,
    table: Floats,
    scene: Floats,
    half: Floats,
    look: int,
    color: Pictures,
    ground: Pictures,
    distance: Pictures,
) -> None:
    """Write the colour of every pixel, and its place on the pitch; NaN beyond the boards.

    Args:
        grid: of `plane_grid`.
        o: (3,) the camera's center.
        r: (3, 3) world from camera.
        paint: of `paint_rows`.
        table: (64, 64) random numbers of the grass.
        scene: length and width of the pitch, its bend, contrast of stripes, paint.
        half: (2,) half the distances between the boards [m].
        look: seed of the stadium's look.
        color: (height, width, 3), written.
        ground: (height, width, 2), written.
        distance: (height, width) from the camera [m], written; infinite in the sky.
    """
    place = np.empty(8)
    bend = scene[2]
    for v in range(color.shape[0]):
        for u in range(color.shape[1]):
            x, y, xu, yu, xv, yv = _looked(grid, u, v)
            dx = r[0, 0] * x + r[0, 1] * y + r[0, 2]
            dy = r[1, 0] * x + r[1, 1] * y + r[1, 2]
            dz = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            s = surface_hit(o, dx, dy, dz, bend)
            place[0], place[1] = o[0] + s * dx, o[1] + s * dy
            slope = 2.0 * bend * place[1]
            sink = slope * dy + dz
            step = np.sqrt(dx * dx + dy * dy + dz * dz)
            distance[v, u] = s * step
            for k in range(2):
                a, b = (xu, yu) if k == 0 else (xv, yv)
                ex, ey = r[0, 0] * a + r[0, 1] * b, r[1, 0] * a + r[1, 1] * b
                ez = r[2, 0] * a + r[2, 1] * b
                ds = -s * (slope * ey + ez) / sink
                place[2 + 2 * k] = s * ex + ds * dx
                place[3 + 2 * k] = s * ey + ds * dy
            place[6], place[7] = dx / sink, dy / sink
            inside = min(half[0] - abs(place[0]), half[1] - abs(place[1]))
            # A board hides the ground behind it as far as the ray is below its top; pixels that see
            # only ground skip the scenery.
            clear = (BOARD_HEIGHT + 0.3) * (abs(dx) + abs(dy)) / abs(dz) + 1.0
            if inside > clear:
                ground[v, u, 0], ground[v, u, 1] = place[0], place[1]
                _turf(paint, table, place, scene, color[v, u])
                continue
            ground[v, u, 0] = ground[v, u, 1] = np.nan
            color[v, u] = 0.0
            on_ground = 0
            for part in range(4):
                du, dv = 0.5 * (part % 2) - 0.25, 0.5 * (part // 2) - 0.25
                a, b = x + du * xu + dv * xv, y + du * yu + dv * yv
                red, green, blue, far = scenery(
                    o,
                    r[0, 0] * a + r[0, 1] * b + r[0, 2],
                    r[1, 0] * a + r[1, 1] * b + r[1, 2],
                    r[2, 0] * a + r[2, 1] * b + r[2, 2],
                    half,
                    bend,
                    look,
                )
                distance[v, u] = min(distance[v, u], far * step)
                if red < 0.0:
                    on_ground += 1
                else:
                    color[v, u, 0] += 0.25 * red
                    color[v, u, 1] += 0.25 * green
                    color[v, u, 2] += 0.25 * blue
            if on_ground > 0:
                beyond = color[v, u].copy()
                _turf(paint, table, place, scene, color[v, u])
                for channel in range(3):
                    color[v, u, channel] *= 0.25 * on_ground
                    color[v, u, channel] += beyond[channel]
                if on_ground == 4:
                    ground[v, u, 0], ground[v, u, 1] = place[0], place[1]


@compiled
def _turf(paint: Floats, table: Floats, place: Floats, scene: Floats, color: Pictures) -> None:
    """Write the colour (3,) of grass and paint at a place."""
    bright, yellow = grass(table, place, scene[0], scene[1], scene[3])
    color[0] = bright * (0.315 + 0.014 * yellow)
    color[1] = bright * 0.475
    color[2] = bright * (0.205 - 0.006 * yellow)
    cover = scene[4] * paint_cover(paint, place)
    if cover > 0.0:
        # Grass shows through worn paint.
        cover *= min(0.88 + 0.06 * wear(table, place), 0.97)
        white = 0.9 + 0.03 * (bright - 1.0)
        color[0] += cover * (white - color[0])
        color[1] += cover * (white + 0.01 - color[1])
        color[2] += cover * (white - color[2])
