"""Images of the simulated stadium: single images, and the broadcast camera's video.

A camera that turns and zooms about a fixed center always stays within one panorama from there: all
static content is rendered once, finer than any frame, and every frame samples it through its own
lens.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.errors import InputError
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
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.mannequins import Cast, Mannequin, Role, Surfaces, dress_people
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.venues import (
    CELL,
    FOG_COLOR,
    Prop,
    Venue,
    build_venue,
    grid_pixels,
    paint_empty,
    paint_venue,
)


def outline_shadows(venue: Venue, camera: Camera, vertices: Singles, light: Floats) -> Outlines:
    """Return outlines of the shadows that surfaces (persons, vertices, 3) [m] cast on the grass.

    None beyond the boards, or where the stand's shadow is. `light` is (4,) direction down from it,
    z = -1, and its share of all light.
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

    `things` are faces (triangles, 3) and vertices (things, vertices, 3) [m], world, of what casts
    shadows; the image (height, width, 3) is changed in place.
    """
    soft = 0.9  # standard deviation of a shadow's rim [px]: some centimetres
    height, width = image.shape[:2]
    mask = np.zeros((height, width), dtype=np.uint8)
    taken = np.zeros(256, dtype=np.uint8)  # levels that each combination of lights takes
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


@dataclass(frozen=True, eq=False)
class SceneView:
    """A camera before an empty stadium.

    Attributes:
        venue: the stadium.
        camera: a single camera.
        scene: (height, width, 3) RGB, before the lens; without goals.
        grain: noise of `sensor_grain`.
    """

    venue: Venue
    camera: Camera
    scene: Image
    grain: NDArray[np.int8]

    def expose(self, moment: Moment, frame: int = 0) -> RenderedFrame:
        """Return the image of people before the scene; the frame seeds the place of the noise."""
        venue, scene = self.venue, self.scene.copy()
        height, width = scene.shape[:2]
        cast, goals = moment.cast, venue.goals
        persons = len(cast.shaped)
        things = [(goals.faces, goals.surfaces.vertices)]
        things.append((cast.mannequin.faces, moment.opened.vertices))
        shade_ground(venue, self.camera, scene, things)
        drawn, spans, boxes = _outline_surfaces(venue, self.camera, moment, width, height)
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
        noise = self.grain[down : down + height, across : across + width]
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
    direct_light = 1.3  # on a surface that faces a light, per share that its shadow takes [1]
    for way in venue.lights:
        toward = (-way[:3] / np.linalg.norm(way[:3])).astype(np.float32)
        direct = np.float32(direct_light * way[3]) * np.maximum(normals @ toward, np.float32(0.0))
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
    """Return regions that share no pixel, each with the indices of the things in its box."""
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


def open_view(
    camera: Camera, pitch: PitchTemplate, seed: int, settings: RenderingSettings | None = None
) -> SceneView:
    """Return a static camera's view of a stadium, about a second for 1920 x 1080.

    The seed is that of the stadium's look, the same for all its cameras, and of the sensor's noise.
    """
    venue = build_venue(pitch, seed, settings or RenderingSettings())
    return SceneView(venue, camera, paint_empty(venue, camera), sensor_grain(venue, camera))


def render_pitch(
    camera: Camera, pitch: PitchTemplate, people: BodyParameters | None, seed: int
) -> Image:
    """Return one image (height, width, 3) in RGB; the same arguments give the same bytes.

    Painted lines are `LINE_WIDTH` wide with the template's lines in their middle. `people` are
    bodies (persons,), world. The seed is that of the stadium's look, kits and noise.
    """
    if camera.batch_shape:
        raise InputError(
            "render_pitch: camera",
            expected="a single camera",
            found=f"a batch of shape {camera.batch_shape}",
            todo="Pass one camera of the batch, for example cameras[0].",
        )
    if people is None:
        people = BodyParameters(*(np.empty((0, n)) for n in (10, 3, BODY_POSE, 3)))
    roles: list[Role] = [("first", "second")[n % 2] for n in range(len(people.betas))]
    cast = dress_people(people.betas, roles, seed)
    posed = cast.pose(people)
    return open_view(camera, pitch, seed).expose(Moment(cast, posed, posed)).image


_FINER: Final = 1.15
"""Pixels of the panorama per pixel of the frame, along each axis."""


@dataclass(frozen=True, eq=False)
class Panorama:
    """All static content, on a cylinder about a vertical axis through the center.

    Attributes:
        levels: (height, width, 3) RGB, each level half as fine as the one before.
        scale: pixels per radian of the first.
        pan: direction of its left border, from the world's y axis towards x [rad].
        rise: tangent of the elevation at its upper border.
        center: (3,) [m], world.
    """

    levels: tuple[Image, ...]
    scale: float
    pan: float
    rise: float
    center: Floats


def render_panorama(cameras: Camera, venue: Venue) -> Panorama:
    """Return a turning camera's panorama of the stadium; InputError if its center moves."""
    strip = 512  # width of the strips that are painted one after the other, to save memory [px]
    center = cameras.center[0]
    if not np.allclose(cameras.center, center, rtol=0.0, atol=1e-6):
        raise InputError(
            "render_panorama: cameras",
            expected="one center for all frames",
            found=f"centers up to {np.abs(cameras.center - center).max():.3g} m apart",
            todo="Render the frames of a camera that moves one by one with render_pitch.",
        )
    pan, rise = _field_of_view(cameras)
    scale = _FINER * float(cameras.focal.max())
    margin_rad = 0.01  # around the frames' field of view [rad]
    left, top = pan[0] - margin_rad, rise[1] + margin_rad
    width = int(np.ceil((pan[1] + margin_rad - left) * scale))
    height = int(np.ceil((top - rise[0] + margin_rad) * scale))
    columns, rows = grid_pixels(width, height)
    angle, up = left + (columns + 0.5) / scale, top - (rows + 0.5) / scale
    grid = np.stack([np.sin(angle), np.cos(angle), up], axis=-1)
    strips = [
        paint_venue(
            venue,
            np.ascontiguousarray(grid[:, begin // CELL : (begin + strip) // CELL + 3]),
            center,
            (min(strip, width - begin), height),
        )
        for begin in range(0, width, strip)
    ]
    whole = np.concatenate(strips, axis=1)
    levels = [whole]
    while scale / 2 ** len(levels) > 0.5 * float(cameras.focal.min()):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    return Panorama(tuple(levels), scale, left, top, center)


def film_broadcast(
    cameras: Camera, venue: Venue, moments: Iterable[Moment]
) -> Iterator[RenderedFrame]:
    """Yield a clip's frames of cameras (frames,); InputError if these have several centers."""
    panorama = render_panorama(cameras, venue)
    grain = sensor_grain(venue, cameras[0])
    width, height = (int(n) for n in cameras.image_size.reshape(-1, 2)[0])
    for frame, moment in enumerate(moments):
        scene = _sample_panorama(panorama, cameras[frame], width, height)
        yield SceneView(venue, cameras[frame], scene, grain).expose(moment, frame)


def _field_of_view(cameras: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return lowest and highest pan [rad] and tangent of the elevation in all frames."""
    width, height = (float(n) for n in cameras.image_size.reshape(-1, 2)[0])
    across, along = np.linspace(0.0, width - 1.0, 9), np.linspace(0.0, height - 1.0, 5)
    border = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    rays = cameras.unproject(border).directions
    pan = np.arctan2(rays[..., 0], rays[..., 1])
    rise = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    return (float(pan.min()), float(pan.max())), (float(rise.min()), float(rise.max()))


def _sample_panorama(panorama: Panorama, camera: Camera, width: int, height: int) -> Image:
    """Return a camera's image of a panorama (height, width, 3)."""
    grid_px = 8  # spacing of the lens inversion [px]: between the nodes its error is 0.005 px
    columns, rows = -(-width // grid_px) + 1, -(-height // grid_px) + 1
    # With this offset, enlarging the grid puts its first entry on the first pixel.
    u = np.arange(columns) * grid_px + 0.5 * (grid_px - 1.0)
    v = np.arange(rows) * grid_px + 0.5 * (grid_px - 1.0)
    u, v = np.concatenate([[u[0] - grid_px], u]), np.concatenate([[v[0] - grid_px], v])
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    plane = camera.normalize(pixels.reshape(-1, 2))
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    rays = rays @ camera.cam_from_world.rotation
    pan = np.arctan2(rays[:, 0], rays[:, 1])
    rise = rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
    level = int(np.floor(np.log2(panorama.scale / (_FINER * float(camera.focal[0])))))
    level = min(max(level, 0), len(panorama.levels) - 1)
    shrunk = 2.0**level
    x = (pan - panorama.pan) * panorama.scale / shrunk - 0.5
    y = (panorama.rise - rise) * panorama.scale / shrunk - 0.5
    # `pyrDown` keeps every second pixel: its pixel i is the finer level's 2 i.
    x, y = x + 0.5 - 0.5 / shrunk, y + 0.5 - 0.5 / shrunk
    grid = np.stack([x, y], axis=-1).astype(np.float32).reshape(len(v), len(u), 2)
    size = (len(u) * grid_px, len(v) * grid_px)
    fine = cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)
    fine = fine[grid_px : grid_px + height, grid_px : grid_px + width]
    looked = cv2.remap(
        panorama.levels[level],
        fine[..., 0],
        fine[..., 1],
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(looked, dtype=np.uint8)
