"""Images of the synthetic stadium: the pitch, its surroundings and people, seen by a camera.

Stage 3 of static calibration must cope with mown stripes, worn and distorted lines, boards full of
edges, people on the lines, their shadows and that of a stand.
"""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.capsules import goal_capsules, person_capsules
from worldpose.simulation.looks import RenderingSettings
from worldpose.simulation.venues import build_venue, draw_capsules, paint_empty

Pictures = NDArray[np.float32]

__all__ = ["RenderingSettings", "render_pitch"]


def render_pitch(
    camera: Camera,
    pitch: PitchTemplate,
    people: NDArray[np.float64] | None,
    seed: int,
    settings: RenderingSettings | None = None,
    *,
    frame: int = 0,
) -> NDArray[np.uint8]:
    """Return one image (height, width, 3) in RGB; the same arguments give the same bytes.

    Painted lines are `LINE_WIDTH` wide with the template's lines in their middle.

    Args:
        camera: a single camera.
        pitch: the painted pitch; the surface follows its crown.
        people: (persons, 17, 3) joints of COCO-17 [m], world; None = no people.
        seed: of the stadium's look, the same for all its cameras, and of the sensor's noise.
        settings: the defaults if None.
        frame: seeds the noise of this image of a clip.

    Raises:
        InputError: a batch of cameras, or people of another shape.
    """
    settings = settings or RenderingSettings()
    _check(camera, people)
    venue = build_venue(pitch, seed, settings)
    # The stadium's look must not depend on the people in it.
    kits = np.random.default_rng([seed, 2])
    limbs, colors = person_capsules(np.empty((0, 17, 3)) if people is None else people, kits)
    goals, goal_colors = goal_capsules(pitch)
    seen = paint_empty(venue, camera, (limbs, goals))
    draw_capsules(venue, camera, seen.color, [*limbs, *goals], [*colors, *goal_colors])
    venue.fogged(seen.color, seen.distance)
    return _developed(seen.color, camera, settings, seed, frame)


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


def _developed(
    color: Pictures, camera: Camera, settings: RenderingSettings, seed: int, frame: int
) -> NDArray[np.uint8]:
    """Return the light (height, width, 3) after lens and sensor."""
    seen = np.asarray(255.0 * settings.exposure * color, dtype=np.float32)
    if settings.blur > 0.0:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), settings.blur), dtype=np.float32)
    which = zlib.crc32(camera.cam_from_world.translation.tobytes())
    rng = np.random.default_rng([seed, frame, which])
    if settings.noise > 0.0:
        grain = rng.standard_normal(seen.shape[:2], dtype=np.float32)
        seen += np.float32(settings.noise) * grain[..., None]
    np.clip(np.rint(seen, out=seen), 0.0, 255.0, out=seen)
    return np.asarray(seen.astype(np.uint8))
