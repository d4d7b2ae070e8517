"""Image formation of one exposure: shadows, people and things over a scene, lens and sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from worldpose.compiled import compile_kernel
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
from worldpose.simulation.cast import Cast, Prop
from worldpose.simulation.mannequins import Surfaces
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.venues import FOG_COLOR, Venue


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
    ground = np.array([*venue.bend, *venue.half, venue.side, edge])
    _throw(vertices, light, ground, fallen)
    return outline_surfaces(camera, fallen)


@compile_kernel
def _throw(vertices: Singles, light: Floats, ground: Floats, fallen: Singles) -> None:
    """Write the grass points in the shadows of vertices; NaN where none is darkened.

    Args:
        vertices: (persons, vertices, 3) [m], world.
        light: (4,), its direction down first.
        ground: both bends of the surface, half the distances between the boards along x and y, the
            side of the stand that casts a shadow, and the start of that shadow.
        fallen: (persons, vertices, 3), written.
    """
    for p in range(vertices.shape[0]):
        for v in range(vertices.shape[1]):
            x, y, z = vertices[p, v, 0], vertices[p, v, 1], vertices[p, v, 2]
            up = max(z + ground[0] * x * x + ground[1] * y * y, 0.0)
            gx, gy = x + up * light[0], y + up * light[1]
            if not (abs(gx) < ground[2] and abs(gy) < ground[3] and ground[4] * gy < ground[5]):
                fallen[p, v] = np.nan
                continue
            fallen[p, v, 0], fallen[p, v, 1] = gx, gy
            fallen[p, v, 2] = -ground[0] * gx * gx - ground[1] * gy * gy


Faces = NDArray[np.int32]

SKY: Final = np.array([0.0, 0.0, -1.0, 0.2])
"""Ambient light, as a light straight from above: dims the grass at the feet."""
SOFT: Final = 0.9
"""Standard deviation of a shadow's rim [px]: some centimetres."""
_MARGIN: Final = 3
"""Margin around a shadow, the extent of its rim [px]."""


def shade_ground(
    venue: Venue, camera: Camera, image: Image, things: Sequence[tuple[Faces, Singles]]
) -> list[Box]:
    """Darken the grass in shadows, and return the boxes that changed.

    Args:
        venue: the stadium and its lights.
        camera: a single camera.
        image: (height, width, 3), changed in place.
        things: faces (triangles, 3) and vertices (things, vertices, 3) [m], world, of objects that
            cast shadows.
    """
    height, width = image.shape[:2]
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
        _darken(image[part], dark[part])
    return boxes


@compile_kernel
def _darken(picture: Image, dark: Image) -> None:
    """Subtract a share (height, width) [1/255] from an image, and reset the share to zero."""
    for v in range(picture.shape[0]):
        for u in range(picture.shape[1]):
            left = 255 - int(dark[v, u])
            if left == 255:
                continue
            for k in range(3):
                picture[v, u, k] = (int(picture[v, u, k]) * left + 127) // 255
            dark[v, u] = 0


AMBIENT: Final = 0.58
"""Ambient light on an upright surface [1]."""
FROM_ABOVE: Final = 0.12
"""Additional ambient light on a surface that faces up [1]."""
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
    """People and other things while the shutter is open.

    Attributes:
        cast: the people.
        opened: their surfaces when the shutter opens.
        closed: their surfaces when it closes.
        props: static things.
    """

    cast: Cast
    opened: Surfaces
    closed: Surfaces
    props: Sequence[Prop]


def expose(
    venue: Venue, camera: Camera, sharp: Image, blurred: Image, grain: NDArray[np.int8],
    moment: Moment, frame: int,
) -> RenderedFrame:  # fmt: skip
    """Return the image of people before a scene.

    Args:
        venue: the stadium.
        camera: a single camera.
        sharp: (height, width, 3) the scene without them; changed in place.
        blurred: the same image through the lens; changed in place.
        grain: grain of `sensor_grain`.
        moment: people and things in the scene.
        frame: seeds the noise of this image.
    """
    height, width = sharp.shape[:2]
    cast = moment.cast
    persons = len(cast.shaped)
    throwing = [(each.faces, each.surfaces.vertices) for each in moment.props if each.shadow]
    throwing.append((cast.mannequin.faces, moment.opened.vertices))
    changed = shade_ground(venue, camera, sharp, throwing)
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
        resolve(samples.who, samples.color, sharp[part], ids[part], seen)
        changed.append((left, top, right, bottom))
    for box in changed:
        _refocus(venue.settings, sharp, blurred, box)
    rng = np.random.default_rng([venue.seed, 7, frame])
    down, across = (int(n) for n in rng.integers(_SPARE, size=2))
    _add_grain(blurred, grain[down : down + height, 3 * across : 3 * (across + width)])
    visible = np.where(filled > 0, seen / np.maximum(filled, 1), 0.0)
    return RenderedFrame(blurred, ids, boxes, visible)


def _outline_surfaces(
    venue: Venue, camera: Camera, moment: Moment, width: int, height: int
) -> tuple[list[Surface], list[Box | None], Floats]:
    """Return all surfaces, people first; the image region of each; people's boxes (n, 4)."""
    cast = moment.cast
    opened = outline_surfaces(camera, moment.opened.vertices)
    closed = opened
    if moment.closed is not moment.opened:
        closed = outline_surfaces(camera, moment.closed.vertices)
    light = _shade_surfaces(venue, moment.opened)
    shape = cast.mannequin
    drawn = [
        Surface(
            faces=shape.faces,
            backs=shape.backs,
            texels=shape.texels,
            textures=image,
            opened=first,
            closed=last,
            light=brightness,
        )
        for image, first, last, brightness in zip(
            cast.images, opened.pixels, closed.pixels, light, strict=True
        )
    ]
    spans = [_exposed_box(opened, closed, person, width, height) for person in range(len(drawn))]
    for prop in moment.props:
        outline = outline_surfaces(camera, prop.surfaces.vertices)
        pixels = outline.pixels[0]
        lit = _shade_surfaces(venue, prop.surfaces)[0]
        drawn.append(
            Surface(
                faces=prop.faces,
                backs=prop.backs,
                texels=prop.texels,
                textures=prop.image,
                opened=pixels,
                closed=pixels,
                light=lit,
            )
        )
        spans.append(outline.box(0, 1, width, height))
    both = np.stack([opened.boxes, closed.boxes])
    boxes = np.concatenate([both[..., :2].min(axis=0), both[..., 2:].max(axis=0)], axis=1)
    return drawn, spans, boxes


def _exposed_box(
    opened: Outlines, closed: Outlines, person: int, width: int, height: int
) -> Box | None:
    a, b = (each.box(person, 1, width, height) for each in (opened, closed))
    if a is None or b is None:
        return None
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _shade_surfaces(venue: Venue, surfaces: Surfaces) -> Singles:
    """Return the light (persons, vertices) on surfaces, 1 = their own colour."""
    normals, vertices = surfaces.normals, surfaces.vertices
    light = np.float32(AMBIENT) + np.float32(FROM_ABOVE) * normals[..., 2]
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


def blur_by_lens(light: Singles, settings: RenderingSettings) -> Singles:
    """Return an image blurred by the lens."""
    if settings.blur_px == 0.0:
        return light
    return np.asarray(cv2.GaussianBlur(light, (0, 0), settings.blur_px), dtype=np.float32)


def to_bytes(light: Singles) -> Image:
    """Return levels of 255 rounded and clipped."""
    return np.asarray(np.clip(np.rint(light), 0.0, 255.0), dtype=np.uint8)


def sensor_grain(venue: Venue, camera: Camera) -> NDArray[np.int8]:
    """Return a camera's noise (height + 64, 3 (width + 64)), the same for all colours."""
    width, height = (int(n) for n in camera.image_size.reshape(-1, 2)[0])
    center = np.abs(np.rint(1e3 * camera.center.reshape(-1, 3)[0])).astype(int)
    rng = np.random.default_rng([venue.seed, 3, *center])
    field = rng.standard_normal((height + _SPARE, width + _SPARE), dtype=np.float32)
    levels = np.clip(np.rint(np.float32(venue.settings.noise) * field), -127, 127)
    return np.repeat(levels.astype(np.int8), 3, axis=1)


def _refocus(settings: RenderingSettings, sharp: Image, blurred: Image, box: Box) -> None:
    """Write `sharp` blurred by the lens into `blurred` around a box."""
    height, width = sharp.shape[:2]
    left, top = max(box[0] - _MARGIN, 0), max(box[1] - _MARGIN, 0)
    right, bottom = min(box[2] + _MARGIN, width), min(box[3] + _MARGIN, height)
    if settings.blur_px == 0.0:
        blurred[top:bottom, left:right] = sharp[top:bottom, left:right]
        return
    a, b = max(left - _MARGIN, 0), max(top - _MARGIN, 0)
    part = sharp[b : bottom + _MARGIN, a : right + _MARGIN]
    soft = cv2.GaussianBlur(part, (0, 0), settings.blur_px)
    blurred[top:bottom, left:right] = soft[top - b : bottom - b, left - a : right - a]


@compile_kernel
def _add_grain(picture: Image, grain: NDArray[np.int8]) -> None:
    """Add noise (height, 3 width) to an image (height, width, 3), in place."""
    for v in range(picture.shape[0]):
        row, noise = picture[v].reshape(-1), grain[v]
        for u in range(len(row)):
            value = np.int16(row[u]) + np.int16(noise[u])
            row[u] = np.uint8(min(max(value, np.int16(0)), np.int16(255)))
