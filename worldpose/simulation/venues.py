"""A stadium as rendered: its look, its lights, and its image without people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Image, Singles
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.mannequins import Surfaces
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

CELL: Final = 4
"""Grid spacing of rays [px]: between the nodes, straight lines have errors of k1 / focal length of
a pixel, a few ten-thousandths."""


def grid_pixels(width: int, height: int) -> tuple[Floats, Floats]:
    """Return column and row (rows, columns) of every fourth pixel, from (-4, -4)."""
    u = np.arange(-CELL, width + 2 * CELL, CELL, dtype=np.float64)
    v = np.arange(-CELL, height + 2 * CELL, CELL, dtype=np.float64)
    columns, rows = np.meshgrid(u, v)
    return columns, rows


@compile_kernel
def _interpolate_ray(grid: Floats, u: float, v: float, ray: Floats) -> None:
    """Write the direction at a pixel, and its changes to the right and down (3, 3)."""
    gu, gv = u / CELL + 1.0, v / CELL + 1.0
    i, j = int(gu), int(gv)
    fu, fv = gu - i, gv - j
    for k in range(3):
        a, b, c, d = grid[j, i, k], grid[j, i + 1, k], grid[j + 1, i, k], grid[j + 1, i + 1, k]
        ray[0, k] = (1 - fv) * ((1 - fu) * a + fu * b) + fv * ((1 - fu) * c + fu * d)
        ray[1, k] = ((1 - fv) * (b - a) + fv * (d - c)) / CELL
        ray[2, k] = ((1 - fu) * (c - a) + fu * (d - b)) / CELL


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
    grid: Floats, o: Floats, stadium: SceneRows, color: Singles, ground: Singles, distance: Singles
) -> None:
    """Write the colour of every pixel, and its place on the pitch; NaN beyond the boards.

    `grid` (rows, columns, 3) are directions of rays at `grid_pixels`, world, from `o` (3,). Written
    are `color` (height, width, 3), `ground` (height, width, 2) and `distance` (height, width) [m],
    infinite in the sky.
    """
    paint, table, scene, half, look = stadium
    place, ray = np.empty(8), np.empty((3, 3))
    bend = scene[2:4]
    for v in range(color.shape[0]):
        for u in range(color.shape[1]):
            _interpolate_ray(grid, u, v, ray)
            dx, dy, dz = ray[0]
            s = surface_hit(o, dx, dy, dz, bend)
            place[0], place[1] = o[0] + s * dx, o[1] + s * dy
            slope_x, slope_y = 2.0 * bend[0] * place[0], 2.0 * bend[1] * place[1]
            sink = slope_x * dx + slope_y * dy + dz
            step = np.sqrt(dx * dx + dy * dy + dz * dz)
            distance[v, u] = s * step
            for k in (1, 2):
                ds = -s * (slope_x * ray[k, 0] + slope_y * ray[k, 1] + ray[k, 2]) / sink
                place[2 * k] = s * ray[k, 0] + ds * dx
                place[2 * k + 1] = s * ray[k, 1] + ds * dy
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
                x, y, z = ray[0] + du * ray[1] + dv * ray[2]
                red, green, blue, far = scenery(o, x, y, z, half, bend, look)
                distance[v, u] = min(distance[v, u], far * step)
                on_ground += red < 0.0
                if red >= 0.0:
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


@dataclass(frozen=True, eq=False)
class Prop:
    """An object with one surface.

    Attributes:
        faces: (triangles, 3), counter-clockwise seen from outside.
        backs: (triangles,) which of the two images has their colours.
        texels: (vertices, 2) column and row in the image.
        image: (1, 2, rows, columns, 3) RGB.
        surfaces: its position, a batch of 1.
    """

    faces: NDArray[np.int32]
    backs: Flags
    texels: Singles
    image: Image
    surfaces: Surfaces


def goals(pitch: PitchTemplate) -> Prop:
    """Return posts, crossbars and the like: tubes between their ends."""
    names = [name for line in pitch.goals.values() for name in (line.start, line.end)]
    tubes = pitch.positions(names).reshape(-1, 2, 3)
    way = tubes[:, 1] - tubes[:, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    aside = np.cross(way, np.where(np.abs(way[:, 2:]) > 0.9, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    above = np.cross(way, aside)
    corner_count = 8  # of a tube's cross section
    turn = 2.0 * np.pi * np.arange(corner_count) / corner_count
    out = np.cos(turn)[:, None] * aside[:, None] + np.sin(turn)[:, None] * above[:, None]
    radius = 0.06  # of posts and crossbar [m] (Law 1: at most 12 cm across)
    vertices = tubes[:, :, None] + radius * out[:, None]
    normals = np.broadcast_to(out[:, None], vertices.shape)
    k = np.arange(corner_count)
    n = (k + 1) % corner_count
    corners = ((k, n, n + corner_count), (k, n + corner_count, k + corner_count))
    halves = [np.stack(half, axis=1) for half in corners]
    faces = np.concatenate(halves) + 2 * corner_count * np.arange(len(tubes))[:, None, None]
    return Prop(
        faces=faces.reshape(-1, 3).astype(np.int32),
        backs=np.zeros(faces.shape[0] * faces.shape[1], dtype=np.bool_),
        texels=np.zeros((normals.size // 3, 2), dtype=np.float32),
        image=np.full((1, 2, 1, 1, 3), 240, dtype=np.uint8),
        surfaces=Surfaces(
            vertices.reshape(1, -1, 3).astype(np.float32),
            normals.reshape(1, -1, 3).astype(np.float32),
        ),
    )


FOG_COLOR: Final = np.array([0.74, 0.76, 0.78])
"""RGB; a little blue."""


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
    goals: Prop

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


def build_venue(pitch: PitchTemplate, seed: int, settings: RenderingSettings) -> Venue:
    """Return the stadium of a seed."""
    looks = np.random.default_rng([seed, 1])
    table = looks.uniform(-np.sqrt(3.0), np.sqrt(3.0), (64, 64))
    look, side = int(looks.integers(1 << 20)), float(looks.choice([-1.0, 1.0]))
    edge = float(looks.uniform(0.1, 0.8)) * 0.5 * pitch.width
    turn = float(looks.uniform(0.0, 2.0 * np.pi))
    lights = _lights(settings.light, turn, side)
    return Venue(pitch, seed, settings, look, table, side, edge, lights, goals(pitch))


def _lights(kind: str, turn: float, side: float) -> tuple[Floats, ...]:
    if kind == "sun":
        # From behind the stand whose shadow is on the pitch.
        across = np.clip(np.sin(turn), -0.8, 0.8)
        return (np.array([1.3 * across, -1.3 * side * np.sqrt(1.0 - across**2), -1.0, 0.5]),)
    corners = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    return tuple(np.array([0.9 * x, 0.7 * y, -1.0, 0.13]) for x, y in corners)


def paint_venue(venue: Venue, grid: Floats, origin: Floats, size: tuple[int, int]) -> Image:
    """Return the empty stadium along rays (height, width, 3), RGB, with the stand's shadow.

    `grid` (rows, columns, 3) are directions of rays at `grid_pixels`, from `origin` (3,) [m],
    world; `size` is the width and height of the image [px].
    """
    width, height = size
    pitch, settings = venue.pitch, venue.settings
    color = np.empty((height, width, 3), dtype=np.float32)
    ground = np.empty((height, width, 2), dtype=np.float32)
    distance = np.empty((height, width), dtype=np.float32)
    scene = [pitch.length, pitch.width, *venue.bend, settings.stripes, settings.paint]
    rows = SceneRows(paint_rows(pitch), venue.table, np.array(scene), venue.half, venue.look)
    paint_scene(grid, origin, rows, color, ground, distance)
    # RGB by day; by night it is black.
    sky_color = np.array([0.66, 0.74, 0.84])
    if settings.light == "sun":
        color[np.isinf(distance)] = sky_color
    if venue.shade > 0.0:
        dark = np.float32(venue.shade) * venue.in_shadow(ground[..., 1])
        color *= (np.float32(1.0) - dark)[..., None]
    if settings.fog_per_m > 0.0:
        clear = np.exp(np.float32(-settings.fog_per_m) * distance)[..., None]
        color *= clear
        color += (np.float32(1.0) - clear) * FOG_COLOR.astype(np.float32)
    color *= np.float32(255.0 * settings.brightness)
    return np.asarray(np.clip(np.rint(color), 0.0, 255.0), dtype=np.uint8)


def paint_empty(venue: Venue, camera: Camera) -> Image:
    """Return a single camera's image of the empty stadium (height, width, 3)."""
    width, height = (int(n) for n in camera.image_size)
    pixels = np.stack(grid_pixels(width, height), axis=-1)
    plane = camera.normalize(pixels.reshape(-1, 2)).reshape(pixels.shape)
    rays = np.concatenate([plane, np.ones((*plane.shape[:2], 1))], axis=-1)
    grid = np.ascontiguousarray(rays @ camera.cam_from_world.rotation)
    return paint_venue(venue, grid, camera.center, (width, height))
