"""Images of the simulated stadium: single images, and the broadcast camera's video.

Stage 3 of static calibration must cope with mown stripes, worn and distorted lines, boards full of
edges, people on the lines, their shadows and that of a stand.

A camera that turns and zooms about a fixed center always stays within one panorama from there: all
static content is rendered once, finer than any frame, and every frame samples it through its own
lens.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.cast import Cast, dress_people
from worldpose.simulation.image_formation import (
    Moment,
    RenderedFrame,
    expose,
    sensor_grain,
)
from worldpose.simulation.mannequins import Surfaces
from worldpose.simulation.settings import RenderingSettings
from worldpose.simulation.venues import (
    CELL,
    Venue,
    build_venue,
    grid_pixels,
    paint_empty,
    paint_venue,
)


@dataclass(frozen=True, eq=False)
class View:
    """A static camera before an empty stadium.

    Attributes:
        venue: the stadium.
        camera: a single camera.
        scene: (height, width, 3) RGB, before the lens; without goals.
        grain: noise of the sensor.
    """

    venue: Venue
    camera: Camera
    scene: Image
    grain: NDArray[np.int8]


def open_view(
    camera: Camera, pitch: PitchTemplate, seed: int, settings: RenderingSettings | None = None
) -> View:
    """Return a static camera's view of a stadium, about a second for 1920 x 1080.

    Args:
        camera: a single camera.
        pitch: the painted pitch; the surface follows its crown.
        seed: seed of the stadium's look, the same for all its cameras, and of the sensor's noise.
        settings: the defaults if None.
    """
    venue = build_venue(pitch, seed, settings or RenderingSettings())
    return View(venue, camera, paint_empty(venue, camera), sensor_grain(venue, camera))


def render_frame(
    view: View,
    cast: Cast,
    opened: Surfaces,
    closed: Surfaces | None = None,
    *,
    frame: int = 0,
) -> RenderedFrame:
    """Return one image of people; the same arguments give the same bytes.

    Args:
        view: a static camera.
        cast: the people.
        opened: their surfaces when the shutter opens.
        closed: their surfaces when it closes; None = no motion.
        frame: index of the image, which seeds its noise.
    """
    moment = Moment(cast, opened, closed or opened)
    return expose(view.venue, view.camera, view.scene.copy(), view.grain, moment, frame)


def render_pitch(
    camera: Camera,
    pitch: PitchTemplate,
    people: BodyParameters | None,
    seed: int,
    settings: RenderingSettings | None = None,
) -> Image:
    """Return one image (height, width, 3) in RGB; the same arguments give the same bytes.

    Painted lines are `LINE_WIDTH` wide with the template's lines in their middle.

    Args:
        camera: a single camera.
        pitch: the painted pitch.
        people: bodies (persons,), world; None = no people.
        seed: seed of the stadium's look, kits and noise.
        settings: the defaults if None.

    Raises:
        InputError: a batch of cameras.
    """
    if camera.batch_shape:
        raise InputError(
            "render_pitch: camera",
            expected="a single camera",
            found=f"a batch of shape {camera.batch_shape}",
            todo="Pass one camera of the batch, for example cameras[0].",
        )
    people = _NO_PEOPLE if people is None else people
    cast = _dress(people.betas, seed)
    return render_frame(open_view(camera, pitch, seed, settings), cast, cast.pose(people)).image


_NO_PEOPLE: Final = BodyParameters(*(np.empty((0, n)) for n in (10, 3, BODY_POSE, 3)))


def _dress(betas: Floats, seed: int) -> Cast:
    """Return people (persons, 10) of two teams."""
    return dress_people(betas, [("first", "second")[n % 2] for n in range(len(betas))], seed)


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


def render_panorama(cameras: Camera, venue: Venue) -> Panorama:
    """Return a turning camera's panorama of pitch, boards and stands.

    Args:
        cameras: a batch (frames,) with one center.
        venue: the stadium.

    Raises:
        InputError: the cameras have different centers.
    """
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
    left, top = pan[0] - _MARGIN, rise[1] + _MARGIN
    width = int(np.ceil((pan[1] + _MARGIN - left) * scale))
    height = int(np.ceil((top - rise[0] + _MARGIN) * scale))
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
    """Yield a clip's frames, like `render_frame`.

    Args:
        cameras: a batch (frames,) with one center.
        venue: the stadium.
        moments: people in every frame.

    Raises:
        InputError: the cameras have different centers.
    """
    panorama = render_panorama(cameras, venue)
    grain = sensor_grain(venue, cameras[0])
    width, height = (int(n) for n in cameras.image_size.reshape(-1, 2)[0])
    for frame, moment in enumerate(moments):
        scene = _sample_panorama(panorama, cameras[frame], width, height)
        yield expose(venue, cameras[frame], scene, grain, moment, frame)


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
