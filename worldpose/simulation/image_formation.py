"""Image formation of one exposure: shadows, people and things over a scene, lens and sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rasters import (
    NOBODY,
    Box,
    Outlines,
    Samples,
    Surface,
    cover_triangles,
    draw_triangles,
    outline_surfaces,
    resolve,
)
from worldpose.simulation.cast import Cast
from worldpose.simulation.mannequins import Mannequin, Surfaces
from worldpose.simulation.venues import FOG_COLOR, Prop, Venue


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
    bend, way = venue.bend.astype(np.float32), light[:2].astype(np.float32)
    height = np.maximum(vertices[..., 2] + vertices[..., :2] ** 2 @ bend, np.float32(0.0))
    fallen = vertices[..., :2] + height[..., None] * way
    lit = np.all(np.abs(fallen) < venue.half, axis=-1)
    if venue.shade > 0.0 and way.any():
        lit &= venue.side * fallen[..., 1] < venue.edge
    fallen[~lit] = np.nan
    ground = -(fallen**2) @ bend
    places = np.concatenate([fallen, ground[..., None]], axis=-1)
    return outline_surfaces(camera, np.asarray(places, dtype=np.float32))


Faces = NDArray[np.int32]

SKY: Final = np.array([0.0, 0.0, -1.0, 0.2])
"""Ambient light, as a light straight from above: dims the grass at the feet."""


def shade_ground(
    venue: Venue, camera: Camera, image: Image, things: Sequence[tuple[Faces, Singles]]
) -> None:
    """Darken the grass in shadows.

    Args:
        venue: the stadium and its lights.
        camera: a single camera.
        image: (height, width, 3), changed in place.
        things: faces (triangles, 3) and vertices (things, vertices, 3) [m], world, of objects that
            cast shadows.
    """
    soft = 0.9  # standard deviation of a shadow's rim [px]: some centimetres
    height, width = image.shape[:2]
    mask = np.zeros((height, width), dtype=np.uint8)
    # Levels of 255 that each combination of lights takes.
    taken = np.zeros(256, dtype=np.uint8)
    for index, light in enumerate((*venue.lights, SKY)):
        bit = 1 << index
        taken[[value for value in range(256) if value & bit]] += round(255.0 * float(light[3]))
        for faces, vertices in things:
            shadows = outline_shadows(venue, camera, vertices, light)
            for number in range(len(vertices)):
                if shadows.box(number, 0, width, height) is not None:
                    cover_triangles(shadows.pixels[number], faces, bit, mask)
    left = 255 - cv2.GaussianBlur(cv2.LUT(mask, taken), (0, 0), soft)
    cv2.multiply(image, cv2.merge([left] * 3), dst=image, scale=1.0 / 255.0)


DIRECT: Final = 1.3
"""Light on a surface that faces a light source, per share of light that its shadow takes [1]."""
_SPARE: Final = 64
"""Additional rows and columns of noise, for another offset in every frame [px]."""


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """An image with its pixel labels.

    Attributes:
        image: (height, width, 3) RGB.
        person_ids: (height, width) the person that fills most of a pixel, -1 for none.
        boxes: (persons, 4) left, top, right, bottom of every person's whole outline [px], also
            outside the image; NaN for a person who is missing or behind the camera.
        visible: (persons,) unoccluded share of the outline's part in the image [1]; 0 for a person
            outside the image.
    """

    image: Image
    person_ids: NDArray[np.int16]
    boxes: Floats
    visible: Floats


@dataclass(frozen=True, eq=False)
class Moment:
    """People while the shutter is open.

    Attributes:
        cast: the people.
        opened: their surfaces when the shutter opens.
        closed: their surfaces when it closes.
    """

    cast: Cast
    opened: Surfaces
    closed: Surfaces


def expose(
    venue: Venue,
    camera: Camera,
    scene: Image,
    grain: NDArray[np.int8],
    moment: Moment,
    frame: int,
) -> RenderedFrame:
    """Return the image of people before a scene.

    Args:
        venue: the stadium.
        camera: a single camera.
        scene: (height, width, 3) the scene without them, before the lens; changed in place.
        grain: grain of `sensor_grain`.
        moment: the people.
        frame: seeds the noise of this image.
    """
    height, width = scene.shape[:2]
    cast, goals = moment.cast, venue.goals
    persons = len(cast.shaped)
    things = [(goals.faces, goals.surfaces.vertices)]
    things.append((cast.mannequin.faces, moment.opened.vertices))
    shade_ground(venue, camera, scene, things)
    drawn, spans, boxes = _outline_surfaces(venue, camera, moment, width, height)
    ids = np.full((height, width), NOBODY, dtype=np.int16)
    seen, filled = np.zeros(persons, dtype=np.int64), np.zeros(persons, dtype=np.int64)
    for (left, top, right, bottom), members in cluster_boxes(spans):
        samples = Samples.empty(left, top, right, bottom)
        for number in members:
            thing = drawn[number]
            count = draw_triangles(thing, _haze_before(venue, thing.opened), number, samples)
            if number < persons:
                filled[number] = count
        part = (slice(top, bottom), slice(left, right))
        resolve(samples.who, samples.color, scene[part], ids[part], seen)
    image = scene
    if venue.settings.blur_px > 0.0:
        image = np.asarray(cv2.GaussianBlur(scene, (0, 0), venue.settings.blur_px), np.uint8)
    rng = np.random.default_rng([venue.seed, 7, frame])
    down, across = (int(n) for n in rng.integers(_SPARE, size=2))
    noise = grain[down : down + height, across : across + width]
    image = np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)
    visible = np.where(filled > 0, seen / np.maximum(filled, 1), 0.0)
    return RenderedFrame(image, ids, boxes, visible)


def _outline_surfaces(
    venue: Venue, camera: Camera, moment: Moment, width: int, height: int
) -> tuple[list[Surface], list[Box | None], Floats]:
    """Return all surfaces, people first; the image region of each; people's boxes (n, 4)."""
    cast, goals = moment.cast, venue.goals
    opened = outline_surfaces(camera, moment.opened.vertices)
    closed = opened
    if moment.closed is not moment.opened:
        closed = outline_surfaces(camera, moment.closed.vertices)
    posts = outline_surfaces(camera, goals.surfaces.vertices)
    drawn, spans = list[Surface](), list[Box | None]()
    things: tuple[tuple[Mannequin | Prop, Image, Surfaces, Outlines, Outlines], ...] = (
        (cast.mannequin, cast.images, moment.opened, opened, closed),
        (goals, goals.image, goals.surfaces, posts, posts),
    )
    for mesh, images, surfaces, begin, end in things:
        light = _shade_surfaces(venue, surfaces)
        for number, image in enumerate(images):
            pixels = (begin.pixels[number], end.pixels[number])
            drawn.append(
                Surface(mesh.faces, mesh.backs, mesh.texels, image, *pixels, light[number])
            )
            spans.append(_exposed_box(begin, end, number, width, height))
    both = np.stack([opened.boxes, closed.boxes])
    boxes = np.concatenate([both[..., :2].min(axis=0), both[..., 2:].max(axis=0)], axis=1)
    return drawn, spans, boxes


def _exposed_box(
    opened: Outlines, closed: Outlines, number: int, width: int, height: int
) -> Box | None:
    a, b = (each.box(number, 1, width, height) for each in (opened, closed))
    if a is None or b is None:
        return None
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _shade_surfaces(venue: Venue, surfaces: Surfaces) -> Singles:
    """Return the light (persons, vertices) on surfaces, 1 = their own colour."""
    from_above = 0.12  # additional ambient light on a surface that faces up [1]
    ambient = 0.58  # ambient light on an upright surface [1]
    normals, vertices = surfaces.normals, surfaces.vertices
    light = np.float32(ambient) + np.float32(from_above) * normals[..., 2]
    for way in venue.lights:
        toward = (-way[:3] / np.linalg.norm(way[:3])).astype(np.float32)
        direct = np.float32(DIRECT * way[3]) * np.maximum(normals @ toward, np.float32(0.0))
        if venue.shade > 0.0:
            y = vertices[..., 1]
            height = vertices[..., 2] + vertices[..., :2] ** 2 @ venue.bend.astype(np.float32)
            fallen = np.asarray(y + height * np.float32(way[1]), dtype=np.float32)
            direct *= np.float32(1.0) - venue.in_shadow(fallen)
        light = light + direct
    return np.asarray(np.float32(venue.settings.brightness) * light, dtype=np.float32)


def _haze_before(venue: Venue, outline: Singles) -> Singles:
    """Return the haze before a thing, as `draw_triangles` takes it."""
    share = 0.0
    if venue.settings.fog_per_m > 0.0:
        share = 1.0 - np.exp(-venue.settings.fog_per_m * float(np.nanmean(outline[:, 2])))
    return np.array([share, *(255.0 * venue.settings.brightness * FOG_COLOR)], dtype=np.float32)


def cluster_boxes(spans: Sequence[Box | None]) -> list[tuple[Box, list[int]]]:
    """Return image regions that share no pixel, each with the indices of the things in it.

    Args:
        spans: left, top, right, bottom of each thing; None for a thing outside the image.
    """
    parts: list[tuple[Box, list[int]]] = []
    for number, span in enumerate(spans):
        if span is None:
            continue
        box, members = span, [number]
        # A region that grows may reach others that it did not reach before.
        while touching := [each for each in parts if _overlap(each[0], box)]:
            parts = [each for each in parts if each not in touching]
            for other, others in touching:
                low, high = map(min, box[:2], other[:2]), map(max, box[2:], other[2:])
                (left, top), (right, bottom) = low, high
                box, members = (left, top, right, bottom), members + others
        parts.append((box, sorted(members)))
    return parts


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def sensor_grain(venue: Venue, camera: Camera) -> NDArray[np.int8]:
    """Return a camera's noise (height + 64, width + 64, 3), the same for all colours."""
    width, height = (int(n) for n in camera.image_size.reshape(-1, 2)[0])
    center = np.abs(np.rint(1e3 * camera.center.reshape(-1, 3)[0])).astype(int)
    rng = np.random.default_rng([venue.seed, 3, *center])
    field = rng.standard_normal((height + _SPARE, width + _SPARE), dtype=np.float32)
    levels = np.clip(np.rint(np.float32(venue.settings.noise) * field), -127, 127)
    return np.repeat(levels.astype(np.int8)[..., None], 3, axis=2)
