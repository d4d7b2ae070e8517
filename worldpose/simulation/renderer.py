"""Images of the simulated stadium: single images, and the broadcast camera's video.

Stage 3 of static calibration must cope with mown stripes, worn and distorted lines, boards full of
edges, people on the lines, their shadows and that of a stand.

A camera that turns and zooms about a fixed center always stays within one panorama from there: all
static content is rendered once, finer than any frame, and every frame samples it through its own
lens. People are drawn frame by frame; they cast no shadows.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.capsules import draw_things, goal_capsules, person_capsules
from worldpose.simulation.image_formation import Moment, RenderedFrame, expose, sensor_grain
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.venues import Venue, build_venue, draw_capsules, paint_empty, paint_venue


def render_pitch(
    camera: Camera,
    pitch: PitchTemplate,
    people: NDArray[np.float64] | None,
    seed: int,
    settings: RenderingSettings | None = None,
) -> NDArray[np.uint8]:
    """Return one image (height, width, 3) in RGB; the same arguments give the same bytes.

    Painted lines are `LINE_WIDTH` wide with the template's lines in their middle.

    Args:
        camera: a single camera.
        pitch: the painted pitch; the surface follows its crown.
        people: (persons, 17, 3) joints of COCO-17 [m], world; None = no people.
        seed: seed of the stadium's look, the same for all its cameras, and of the sensor's noise.
        settings: the defaults if None.

    Raises:
        InputError: a batch of cameras, or people of another shape.
    """
    settings = settings or RenderingSettings()
    _check_inputs(camera, people)
    venue = build_venue(pitch, seed, settings)
    # The stadium's look must not depend on the people in it.
    kits = np.random.default_rng([seed, 2])
    limbs, colors = person_capsules(np.empty((0, 17, 3)) if people is None else people, kits)
    goals, goal_colors = goal_capsules(pitch)
    seen = paint_empty(venue, camera, (limbs, goals))
    draw_capsules(venue, camera, seen.color, [*limbs, *goals], [*colors, *goal_colors])
    venue.add_fog(seen.color, seen.distance)
    return _develop(seen.color, camera, settings, seed)


def _check_inputs(camera: Camera, people: NDArray[np.float64] | None) -> None:
    if camera.batch_shape:
        raise InputError(
            "render_pitch: camera",
            expected="a single camera",
            found=f"a batch of shape {camera.batch_shape}",
            todo="Pass one camera of the batch, for example cameras[0].",
        )
    if people is not None and people.shape[1:] != (17, 3):
        raise InputError(
            "render_pitch: people",
            expected="shape (persons, 17, 3)",
            found=f"shape {people.shape}",
            todo="Pass the COCO-17 joints of one frame, for example joints[0].",
        )


def _develop(
    color: Singles, camera: Camera, settings: RenderingSettings, seed: int
) -> NDArray[np.uint8]:
    """Return the light (height, width, 3) after lens and sensor."""
    seen = np.asarray(255.0 * settings.brightness * color, dtype=np.float32)
    if settings.blur_px > 0.0:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), settings.blur_px), dtype=np.float32)
    which = zlib.crc32(camera.cam_from_world.translation.tobytes())
    rng = np.random.default_rng([seed, 0, which])
    if settings.noise > 0.0:
        grain = rng.standard_normal(seen.shape[:2], dtype=np.float32)
        seen += np.float32(settings.noise) * grain[..., None]
    np.clip(np.rint(seen, out=seen), 0.0, 255.0, out=seen)
    return np.asarray(seen.astype(np.uint8))


_CELL: Final = 4
"""Spacing of a panorama's grid [px], for `paint_scene`."""
_STRIP: Final = 512
"""Width of a panorama's strips [px]: their rays are straight lines within 4 px."""
_GRID: Final = 8
"""Grid spacing of a frame's lens inversion [px]: between the nodes its error is 0.005 px."""
_MARGIN: Final = 0.01
"""Margin around the frames' field of view [rad]."""
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


def render_panorama(cameras: Camera, venue: Venue, *, lit: bool = False) -> Panorama:
    """Return a turning camera's panorama of pitch, boards and stands.

    Args:
        cameras: a batch (frames,) with one center.
        venue: the stadium.
        lit: with its lights and through its fog; else in even light.

    Raises:
        InputError: the cameras have different centers.
    """
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
    left, top = pan[0] - _MARGIN, rise[1] + _MARGIN
    width = int(np.ceil((pan[1] + _MARGIN - left) * scale))
    height = int(np.ceil((top - rise[0] + _MARGIN) * scale))
    whole = np.empty((height, width, 3), dtype=np.uint8)
    rows = np.arange(-_CELL, height + 2 * _CELL, _CELL)
    for begin in range(0, width, _STRIP):
        count = min(_STRIP, width - begin)
        columns = np.arange(-_CELL, count + 2 * _CELL, _CELL)
        middle = left + (begin + 0.5 * count) / scale
        angle = left + (begin + columns + 0.5) / scale - middle
        down = (rows + 0.5) / scale - top
        x = np.broadcast_to(np.tan(angle), (len(rows), len(columns)))
        y = down[:, None] / np.cos(angle)
        cos, sin = np.cos(middle), np.sin(middle)
        # Columns: right, down and ahead of a level camera that looks along this strip.
        turn = np.array([[cos, 0.0, sin], [-sin, 0.0, cos], [0.0, -1.0, 0.0]])
        seen = paint_venue(venue, np.stack([x, y], axis=-1), center, turn, (count, height))
        color = seen.color
        if lit:
            color *= 1.0 - venue.shade * venue.in_shadow(seen.ground[..., 1])[..., None]
            venue.add_fog(color, seen.distance)
            color *= venue.settings.brightness
        whole[:, begin : begin + count] = np.clip(np.rint(255.0 * color), 0.0, 255.0)
    levels = [whole]
    while scale / 2 ** len(levels) > 0.5 * float(cameras.focal.min()):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    return Panorama(tuple(levels), scale, left, top, center)


def render_broadcast(
    cameras: Camera,
    pitch: PitchTemplate,
    people: Floats | None,
    seed: int,
    settings: RenderingSettings | None = None,
) -> Iterator[Image]:
    """Yield the images (height, width, 3) in RGB of a clip; the same arguments, the same bytes.

    Args:
        cameras: a batch (frames,) with one center.
        pitch: the painted pitch.
        people: (frames, persons, 17, 3) joints of COCO-17 [m], world; None = no people.
        seed: seed of the stadium's look and the sensor's noise.
        settings: the defaults if None; their light is ignored.

    Raises:
        InputError: the cameras have different centers.
    """
    settings = settings or RenderingSettings()
    panorama = render_panorama(cameras, build_venue(pitch, seed, settings))
    kits = np.random.default_rng([seed, 2]).integers(1 << 31)
    goals, goal_colors = goal_capsules(pitch)
    noise = np.random.default_rng([seed, 3])
    width, height = (int(n) for n in cameras.image_size.reshape(-1, 2)[0])
    # One field of noise, with another offset for every frame.
    field = settings.noise * noise.standard_normal((height + 256, width + 256), dtype=np.float32)
    for frame in range(len(cameras.focal)):
        camera = cameras[frame]
        color = np.asarray(_sample_panorama(panorama, camera, width, height), dtype=np.float32)
        color *= np.float32(1.0 / 255.0)
        joints = np.empty((0, 17, 3)) if people is None else people[frame]
        limbs, colors = person_capsules(joints, np.random.default_rng(kits))
        draw_things(
            color,
            camera,
            [*limbs, *goals],
            [*colors, *goal_colors],
            [1.0] * (len(limbs) + len(goals)),
        )
        color *= np.float32(255.0)
        if settings.blur_px > 0.0:
            color = np.asarray(cv2.GaussianBlur(color, (0, 0), settings.blur_px), dtype=np.float32)
        down, right = (int(n) for n in noise.integers(0, 256, 2))
        color += field[down : down + height, right : right + width, None]
        yield np.asarray(cv2.convertScaleAbs(np.maximum(color, 0.0)), dtype=np.uint8)


def film_broadcast(
    cameras: Camera, venue: Venue, moments: Iterable[Moment]
) -> Iterator[RenderedFrame]:
    """Yield a clip's frames, like `worldpose.simulation.matches.render_frame`.

    Args:
        cameras: a batch (frames,) with one center.
        venue: the stadium.
        moments: people and things in every frame.

    Raises:
        InputError: the cameras have different centers.
    """
    panorama = render_panorama(cameras, venue, lit=True)
    grain = sensor_grain(venue, cameras[0])
    width, height = (int(n) for n in cameras.image_size.reshape(-1, 2)[0])
    for frame, moment in enumerate(moments):
        sharp = _sample_panorama(panorama, cameras[frame], width, height)
        blurred = sharp.copy()
        if venue.settings.blur_px > 0.0:
            blurred = np.asarray(cv2.GaussianBlur(sharp, (0, 0), venue.settings.blur_px))
        yield expose(venue, cameras[frame], sharp, blurred, grain, moment, frame)


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
    columns, rows = -(-width // _GRID) + 1, -(-height // _GRID) + 1
    # With this offset, enlarging the grid puts its first entry on the first pixel.
    u = np.arange(columns) * _GRID + 0.5 * (_GRID - 1.0)
    v = np.arange(rows) * _GRID + 0.5 * (_GRID - 1.0)
    u, v = np.concatenate([[u[0] - _GRID], u]), np.concatenate([[v[0] - _GRID], v])
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
    size = (len(u) * _GRID, len(v) * _GRID)
    fine = cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)
    fine = fine[_GRID : _GRID + height, _GRID : _GRID + width]
    looked = cv2.remap(
        panorama.levels[level],
        fine[..., 0],
        fine[..., 1],
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(looked, dtype=np.uint8)
