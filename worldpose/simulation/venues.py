"""A stadium as rendered: its look, its lights, and its image without people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Singles
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.capsules import draw_shadows, draw_things
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.surroundings import (
    BOARD_HEIGHT,
    BOARD_SETBACK,
    grass,
    paint_cover,
    paint_rows,
    scenery,
    surface_hit,
    wear,
)

_CELL: Final = 4
"""Grid spacing of the lens inversion [px]: between the nodes, straight lines have errors of k1 /
focal length of a pixel, a few ten-thousandths."""


def plane_grid(camera: Camera, width: int, height: int) -> Floats:
    """Return undistorted coordinates (rows, columns, 2) of every fourth pixel, from (-4, -4)."""
    u = np.arange(-_CELL, width + 2 * _CELL, _CELL, dtype=np.float64)
    v = np.arange(-_CELL, height + 2 * _CELL, _CELL, dtype=np.float64)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    return camera.normalize(pixels.reshape(-1, 2)).reshape(*pixels.shape)


@compile_kernel
def _interpolate_plane(
    grid: Floats, u: float, v: float
) -> tuple[float, float, float, float, float, float]:
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


class SceneRows(NamedTuple):
    """What `paint_scene` needs to know of a stadium.

    Attributes:
        paint: rows of `paint_rows`.
        table: (64, 64) random numbers of the grass.
        scene: length and width of the pitch, two bends of its surface, contrast of stripes, paint.
        half: (2,) half the distances between the boards [m].
        look: seed of the stadium's look.
    """

    paint: Floats
    table: Floats
    scene: Floats
    half: Floats
    look: int


@compile_kernel
def paint_scene(
    grid: Floats,
    o: Floats,
    r: Floats,
    stadium: SceneRows,
    color: Singles,
    ground: Singles,
    distance: Singles,
) -> None:
    """Write the colour of every pixel, and its place on the pitch; NaN beyond the boards.

    Args:
        grid: grid of `plane_grid`.
        o: (3,) the camera's center.
        r: (3, 3) world from camera.
        stadium: pitch, boards and look.
        color: (height, width, 3), written.
        ground: (height, width, 2), written.
        distance: (height, width) distance from the camera [m], written; infinite in the sky.
    """
    paint, table, scene, half, look = stadium
    place = np.empty(8)
    bend = scene[2:4]
    for v in range(color.shape[0]):
        for u in range(color.shape[1]):
            x, y, xu, yu, xv, yv = _interpolate_plane(grid, u, v)
            dx = r[0, 0] * x + r[0, 1] * y + r[0, 2]
            dy = r[1, 0] * x + r[1, 1] * y + r[1, 2]
            dz = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            s = surface_hit(o, dx, dy, dz, bend)
            place[0], place[1] = o[0] + s * dx, o[1] + s * dy
            slope_x, slope_y = 2.0 * bend[0] * place[0], 2.0 * bend[1] * place[1]
            sink = slope_x * dx + slope_y * dy + dz
            step = np.sqrt(dx * dx + dy * dy + dz * dz)
            distance[v, u] = s * step
            for k in range(2):
                a, b = (xu, yu) if k == 0 else (xv, yv)
                ex, ey = r[0, 0] * a + r[0, 1] * b, r[1, 0] * a + r[1, 1] * b
                ez = r[2, 0] * a + r[2, 1] * b
                ds = -s * (slope_x * ex + slope_y * ey + ez) / sink
                place[2 + 2 * k] = s * ex + ds * dx
                place[3 + 2 * k] = s * ey + ds * dy
            place[6], place[7] = dx / sink, dy / sink
            inside = min(half[0] - abs(place[0]), half[1] - abs(place[1]))
            # A board hides the ground behind it as far as the ray is below its top; pixels that see
            # only ground skip the scenery.
            clear = (BOARD_HEIGHT + 0.3) * (abs(dx) + abs(dy)) / abs(dz) + 1.0
            if inside > clear:
                ground[v, u, 0], ground[v, u, 1] = place[0], place[1]
                _paint_turf(paint, table, place, scene, color[v, u])
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
                _paint_turf(paint, table, place, scene, color[v, u])
                for channel in range(3):
                    color[v, u, channel] *= 0.25 * on_ground
                    color[v, u, channel] += beyond[channel]
                if on_ground == 4:
                    ground[v, u, 0], ground[v, u, 1] = place[0], place[1]


@compile_kernel
def _paint_turf(paint: Floats, table: Floats, place: Floats, scene: Floats, color: Singles) -> None:
    """Write the colour (3,) of grass and paint at a place."""
    bright, yellow = grass(table, place, scene[0], scene[1], scene[4])
    color[0] = bright * (0.315 + 0.014 * yellow)
    color[1] = bright * 0.475
    color[2] = bright * (0.205 - 0.006 * yellow)
    cover = scene[5] * paint_cover(paint, place)
    if cover > 0.0:
        # Grass shows through worn paint.
        cover *= min(0.88 + 0.06 * wear(table, place), 0.97)
        white = 0.9 + 0.03 * (bright - 1.0)
        color[0] += cover * (white - color[0])
        color[1] += cover * (white + 0.01 - color[1])
        color[2] += cover * (white - color[2])


FOG_COLOR: Final = np.array([0.74, 0.76, 0.78])
"""RGB; a little blue."""
SKY_COLOR: Final = np.array([0.66, 0.74, 0.84])
"""RGB by day; by night it is black."""


@dataclass(frozen=True, eq=False)
class Venue:
    """A stadium: the same pitch, seed and settings give the same one for all cameras."""

    pitch: PitchTemplate
    seed: int
    settings: RenderingSettings
    look: int
    """Seed of boards and crowd."""
    table: Floats
    """(64, 64) random numbers of the grass."""
    side: float
    """Side of the stand that casts a shadow, -1 or 1 along y."""
    edge: float
    """Distance of the shadow's edge from the long axis [m]."""
    lights: tuple[Floats, ...]
    """(4,) each: direction down from the light, z = -1, and its share of all light."""

    @property
    def bend(self) -> Floats:
        """Return the coefficients (2,) of the surface, whose height is -bend @ (x^2, y^2) [1/m]."""
        pitch = self.pitch
        half = 0.5 * np.array([pitch.length, pitch.width])
        return np.array([pitch.end_fall, pitch.crown]) / half**2

    @property
    def half(self) -> Floats:
        """Return half the distances between the boards (2,) [m]."""
        return 0.5 * np.array([self.pitch.length, self.pitch.width]) + BOARD_SETBACK

    @property
    def shade(self) -> float:
        """Return the share of the light that the stand blocks in its shadow [1]."""
        return self.settings.stand_shadow if self.settings.light == "sun" else 0.0

    def in_shadow(self, y: Singles) -> Singles:
        """Return the share of the stand's shadow at places y on the ground [1]; 0 for NaN.

        Its edge is soft, over the 0.5 m that the sun's size gives.
        """
        past = np.float32(self.side) * y - np.float32(self.edge)
        dark = np.clip(past / np.float32(0.5) + np.float32(0.5), 0.0, 1.0)
        return np.where(np.isnan(dark), np.float32(0.0), dark)

    def add_fog(self, color: Singles, distance: Singles) -> None:
        """Add fog to colours (..., 3) at distances (...) [m]; in place."""
        if self.settings.fog_per_m > 0.0:
            clear = np.exp(np.float32(-self.settings.fog_per_m) * distance)[..., None]
            color *= clear
            color += (np.float32(1.0) - clear) * FOG_COLOR.astype(np.float32)


def build_venue(pitch: PitchTemplate, seed: int, settings: RenderingSettings) -> Venue:
    """Return the stadium of a seed."""
    looks = np.random.default_rng([seed, 1])
    table = looks.uniform(-np.sqrt(3.0), np.sqrt(3.0), (64, 64))
    look, side = int(looks.integers(1 << 20)), float(looks.choice([-1.0, 1.0]))
    edge = float(looks.uniform(0.1, 0.8)) * 0.5 * pitch.width
    turn = float(looks.uniform(0.0, 2.0 * np.pi))
    return Venue(
        pitch, seed, settings, look, table, side, edge, _lights(settings.light, turn, side)
    )


def _lights(kind: str, turn: float, side: float) -> tuple[Floats, ...]:
    if kind == "sun":
        # From behind the stand whose shadow is on the pitch.
        across = np.clip(np.sin(turn), -0.8, 0.8)
        return (np.array([1.3 * across, -1.3 * side * np.sqrt(1.0 - across**2), -1.0, 0.5]),)
    corners = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    return tuple(np.array([0.9 * x, 0.7 * y, -1.0, 0.13]) for x, y in corners)


@dataclass(frozen=True, eq=False)
class EmptyScene:
    """A camera's image of grass and surroundings, without people.

    Attributes:
        color: (height, width, 3) RGB, 1 = white.
        ground: (height, width, 2) place on the pitch [m]; NaN beyond the boards.
        distance: (height, width) [m]; infinite in the sky.
    """

    color: Singles
    ground: Singles
    distance: Singles


def paint_venue(
    venue: Venue, grid: Floats, center: Floats, world_from_cam: Floats, size: tuple[int, int]
) -> EmptyScene:
    """Return the scene along rays, under even light.

    Args:
        venue: the stadium.
        grid: (rows, columns, 2) grid of `plane_grid`.
        center: (3,) origin of the rays [m], world.
        world_from_cam: (3, 3).
        size: width and height of the image [px].
    """
    width, height = size
    pitch, settings = venue.pitch, venue.settings
    color = np.empty((height, width, 3), dtype=np.float32)
    ground = np.empty((height, width, 2), dtype=np.float32)
    distance = np.empty((height, width), dtype=np.float32)
    paint_scene(
        grid,
        center,
        np.ascontiguousarray(world_from_cam),
        SceneRows(
            paint=paint_rows(pitch),
            table=venue.table,
            scene=np.array(
                [pitch.length, pitch.width, *venue.bend, settings.stripes, settings.paint]
            ),
            half=venue.half,
            look=venue.look,
        ),
        color,
        ground,
        distance,
    )
    if settings.light == "sun":
        color[np.isinf(distance)] = SKY_COLOR
    return EmptyScene(color, ground, distance)


def paint_empty(venue: Venue, camera: Camera, throwing: Sequence[Floats] = ()) -> EmptyScene:
    """Return a camera's image of grass and surroundings, with shadows on the grass.

    Args:
        venue: the stadium.
        camera: a single camera.
        throwing: (things, limbs, 8) capsules that cast shadows in addition to the stand [m], world.
    """
    width, height = (int(n) for n in camera.image_size)
    seen = paint_venue(
        venue,
        plane_grid(camera, width, height),
        camera.center,
        camera.cam_from_world.rotation.T,
        (width, height),
    )
    shade = np.ones((height, width), dtype=np.float32)
    if venue.shade > 0.0:
        shade -= np.float32(venue.shade) * venue.in_shadow(seen.ground[..., 1])
    for light in venue.lights:
        for things in throwing:
            draw_shadows(shade, seen.ground, camera, things, light, venue.bend)
    seen.color[...] *= shade[..., None]
    return seen


def draw_capsules(
    venue: Venue, camera: Camera, color: Singles, things: list[Floats], colors: list[Floats]
) -> None:
    """Draw things made of capsules over an image.

    Args:
        venue: the stadium.
        camera: a single camera.
        color: (height, width, 3) RGB, 1 = white; changed in place.
        things: (limbs, 8) each [m], world.
        colors: (limbs, 3) colors of each.
    """
    lit = []
    for thing in things:
        y = thing[:, 1][np.isfinite(thing[:, 1])]
        in_shadow = len(y) > 0 and venue.side * y.mean() > venue.edge
        lit.append(1.0 - venue.shade * float(in_shadow))
    draw_things(color, camera, things, colors, lit)
