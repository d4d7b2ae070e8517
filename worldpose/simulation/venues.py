"""A stadium as rendered: its look and its lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.capsules import draw_shadows, draw_things
from worldpose.simulation.ground_picture import paint_scene, plane_grid
from worldpose.simulation.looks import RenderingSettings
from worldpose.simulation.surroundings import BOARD_SETBACK
from worldpose.simulation.turf import paint_rows

Pictures = NDArray[np.float32]

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
    def bend(self) -> float:
        """Return the surface's coefficient in z = -bend y^2 [1/m]."""
        return self.pitch.crown / (0.5 * self.pitch.width) ** 2

    @property
    def half(self) -> Floats:
        """Return half the distances between the boards (2,) [m]."""
        return 0.5 * np.array([self.pitch.length, self.pitch.width]) + BOARD_SETBACK

    @property
    def shade(self) -> float:
        """Return the share of the light that the stand blocks in its shadow [1]."""
        return self.settings.stand_shadow if self.settings.light == "sun" else 0.0

    def in_shadow(self, y: Pictures) -> Pictures:
        """Return the share of the stand's shadow at places y on the ground [1]; 0 for NaN.

        Its edge is soft, over the 0.5 m that the sun's size gives.
        """
        past = np.float32(self.side) * y - np.float32(self.edge)
        dark = np.clip(past / np.float32(0.5) + np.float32(0.5), 0.0, 1.0)
        return np.where(np.isnan(dark), np.float32(0.0), dark)

    def fogged(self, color: Pictures, distance: Pictures) -> None:
        """Add fog to colours (..., 3) at distances (...) [m]; in place."""
        if self.settings.fog > 0.0:
            clear = np.exp(np.float32(-self.settings.fog) * distance)[..., None]
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
class Emptiness:
    """A camera's image of grass and surroundings, without people.

    Attributes:
        color: (height, width, 3) RGB, 1 = white.
        ground: (height, width, 2) place on the pitch [m]; NaN beyond the boards.
        distance: (height, width) [m]; infinite in the sky.
    """

    color: Pictures
    ground: Pictures
    distance: Pictures


def paint_venue(
    venue: Venue, grid: Floats, center: Floats, world_from_cam: Floats, size: tuple[int, int]
) -> Emptiness:
    """Return the scene along rays, under even light.

    Args:
        venue: the stadium.
        grid: (rows, columns, 2) of `plane_grid`.
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
        paint_rows(pitch),
        venue.table,
        np.array([pitch.length, pitch.width, venue.bend, settings.stripes, settings.paint]),
        venue.half,
        venue.look,
        color,
        ground,
        distance,
    )
    if settings.light == "sun":
        color[np.isinf(distance)] = SKY_COLOR
    return Emptiness(color, ground, distance)


def paint_empty(venue: Venue, camera: Camera, throwing: Sequence[Floats] = ()) -> Emptiness:
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
    venue: Venue, camera: Camera, color: Pictures, things: list[Floats], colors: list[Floats]
) -> None:
    """Draw things made of capsules over an image.

    Args:
        venue: the stadium.
        camera: a single camera.
        color: (height, width, 3) RGB, 1 = white; changed in place.
        things: (limbs, 8) each [m], world.
        colors: (limbs, 3) of each.
    """
    lit = []
    for thing in things:
        y = thing[:, 1][np.isfinite(thing[:, 1])]
        in_shadow = len(y) > 0 and venue.side * y.mean() > venue.edge
        lit.append(1.0 - venue.shade * float(in_shadow))
    draw_things(color, camera, things, colors, lit)
