"""Pictures of the synthetic stadium: the pitch, its surroundings and people, as a camera has them.

What stage 3 of static calibration must survive: mown stripes, worn and distorted lines, boards
full of edges, people on the lines, their shadows and that of a stand.
"""

from __future__ import annotations

import zlib
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.records import Record
from worldpose.cameras import Camera
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.synthetic.capsules import (
    draw_shadows,
    draw_things,
    goal_capsules,
    person_capsules,
)
from worldpose.synthetic.ground_picture import paint_scene, plane_grid
from worldpose.synthetic.surroundings import BOARD_SETBACK
from worldpose.synthetic.turf import paint_rows

Floats = NDArray[np.float64]
Pictures = NDArray[np.float32]


class RenderingSettings(Record):
    """How a picture looks."""

    stripes: float = Field(default=0.16, ge=0, le=1)
    """Brightness of a mown stripe against its neighbour [1]; 0.1 to 0.2 in broadcast pictures."""
    paint: float = Field(default=1.0, ge=0, le=1)
    """Share of the grass that fresh paint hides [1]; 0 = no markings."""
    light: Literal["sun", "floodlights"] = "sun"
    """One hard shadow a person, or four faint ones."""
    stand_shadow: float = Field(default=0.45, ge=0, le=1)
    """Share of the light that the shadow of a stand keeps off a part of the pitch [1], if the
    sun shines; 0 = no such shadow."""
    blur: float = Field(default=0.7, ge=0)
    """Standard deviation of the lens's and the codec's blur [px]; a sharp broadcast lens."""
    noise: float = Field(default=2.0, ge=0)
    """Standard deviation of the sensor's noise [levels of 255], after a broadcast codec."""


def render_pitch(
    camera: Camera,
    pitch: PitchTemplate,
    people: NDArray[np.float64] | None,
    seed: int,
    settings: RenderingSettings | None = None,
    *,
    frame: int = 0,
) -> NDArray[np.uint8]:
    """Return one picture (height, width, 3) in RGB; the same arguments give the same bytes.

    Painted lines are `LINE_WIDTH` wide with the template's lines in their middle.

    Args:
        camera: a single camera.
        pitch: what is painted; the surface follows its crown.
        people: (persons, 17, 3) joints of COCO-17 [m], world; None = nobody.
        seed: the stadium's look, the same for all its cameras, and the sensor's noise.
        settings: the defaults if None.
        frame: gives every picture of a clip noise of its own.

    Raises:
        InputError: a batch of cameras, or people of another shape.
    """
    settings = settings or RenderingSettings()
    _check(camera, people)
    looks = np.random.default_rng([seed, 1])
    # What the stadium looks like must not depend on who is in it.
    kits = np.random.default_rng([seed, 2])
    table = looks.uniform(-np.sqrt(3.0), np.sqrt(3.0), (64, 64))
    look, side = int(looks.integers(1 << 20)), looks.choice([-1.0, 1.0])
    edge = looks.uniform(0.1, 0.8) * 0.5 * pitch.width
    lights = _lights(settings.light, looks.uniform(0.0, 2.0 * np.pi), side)
    bend = pitch.crown / (0.5 * pitch.width) ** 2

    width, height = (int(n) for n in camera.image_size)
    color = np.empty((height, width, 3), dtype=np.float32)
    shade = np.ones((height, width), dtype=np.float32)
    ground = np.empty((height, width, 2), dtype=np.float32)
    half = 0.5 * np.array([pitch.length, pitch.width]) + BOARD_SETBACK
    scene = np.array([pitch.length, pitch.width, bend, settings.stripes, settings.paint])
    paint_scene(
        plane_grid(camera, width, height),
        camera.center,
        np.ascontiguousarray(camera.cam_from_world.rotation.T),
        paint_rows(pitch),
        table,
        scene,
        half,
        look,
        color,
        ground,
    )
    shadowed = settings.stand_shadow if settings.light == "sun" else 0.0
    if shadowed > 0.0:
        _shade_stand(shade, ground, side, edge, shadowed)
    limbs, colors = person_capsules(np.empty((0, 17, 3)) if people is None else people, kits)
    goals, goal_colors = goal_capsules(pitch)
    for light in lights:
        draw_shadows(shade, ground, camera, limbs, light, bend)
        draw_shadows(shade, ground, camera, goals, light, bend)
    color *= shade[..., None]
    things, paints = [*limbs, *goals], [*colors, *goal_colors]
    lit = [1.0 - shadowed * float(_in_shadow(thing, side, edge)) for thing in things]
    draw_things(color, camera, things, paints, lit)
    return _developed(color, camera, settings, seed, frame)


def _check(camera: Camera, people: NDArray[np.float64] | None) -> None:
    if camera.batch_shape:
        raise InputError(
            "render_pitch: camera",
            expected="a single camera",
            found=f"a batch of shape {camera.batch_shape}",
            todo="Index the batch first.",
        )
    if people is not None and people.shape[1:] != (17, 3):
        raise InputError(
            "render_pitch: people",
            expected="shape (persons, 17, 3)",
            found=f"shape {people.shape}",
            todo="Give the COCO-17 joints of one frame.",
        )


def _lights(kind: str, turn: float, side: float) -> list[Floats]:
    """Return where light comes from, as `draw_shadows` takes it."""
    if kind == "sun":
        # From behind the stand whose shadow lies on the pitch.
        across = np.clip(np.sin(turn), -0.8, 0.8)
        return [np.array([1.3 * across, -1.3 * side * np.sqrt(1.0 - across**2), -1.0, 0.5])]
    corners = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    return [np.array([0.9 * x, 0.7 * y, -1.0, 0.13]) for x, y in corners]


def _in_shadow(thing: Floats, side: float, edge: float) -> bool:
    """Return whether a thing stands in the shadow of the stand."""
    middle = thing[:, 1][np.isfinite(thing[:, 1])]
    return bool(len(middle) and side * middle.mean() > edge)


def _shade_stand(shade: Pictures, ground: Pictures, side: float, edge: float, share: float) -> None:
    """Darken the ground beyond a line along x, softly over the 0.5 m that the sun's size gives."""
    past = np.float32(side) * ground[..., 1] - np.float32(edge)
    dark = np.clip(past / np.float32(0.5) + np.float32(0.5), 0.0, 1.0)
    shade *= np.where(np.isnan(dark), np.float32(1.0), np.float32(1.0) - np.float32(share) * dark)


def _developed(
    color: Pictures, camera: Camera, settings: RenderingSettings, seed: int, frame: int
) -> NDArray[np.uint8]:
    """Return what lens and sensor make of the light (height, width, 3)."""
    seen = np.asarray(255.0 * color, dtype=np.float32)
    if settings.blur > 0.0:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), settings.blur), dtype=np.float32)
    which = zlib.crc32(camera.cam_from_world.translation.tobytes())
    rng = np.random.default_rng([seed, frame, which])
    if settings.noise > 0.0:
        grain = rng.standard_normal(seen.shape[:2], dtype=np.float32)
        seen += np.float32(settings.noise) * grain[..., None]
    np.clip(np.rint(seen, out=seen), 0.0, 255.0, out=seen)
    return np.asarray(seen.astype(np.uint8))
