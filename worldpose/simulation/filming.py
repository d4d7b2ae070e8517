"""Frames of static cameras: people in kits in front of a stadium."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.casting import Cast
from worldpose.simulation.image_formation import (
    Moment,
    RenderedFrame,
    expose,
    sensor_grain,
    through_lens,
    to_bytes,
)
from worldpose.simulation.looks import RenderingSettings
from worldpose.simulation.mannequins import Surfaces
from worldpose.simulation.props import Prop, goals
from worldpose.simulation.venues import Venue, build_venue, paint_empty

Bytes = NDArray[np.uint8]

__all__ = ["RenderedFrame", "View", "open_view", "render_frame"]


@dataclass(frozen=True, eq=False)
class View:
    """A static camera before an empty stadium.

    Attributes:
        venue: the stadium.
        camera: a single camera.
        sharp: (height, width, 3) RGB, before the lens; without goals.
        blurred: the same through the lens.
        grain: noise of the sensor.
        props: the goals.
    """

    venue: Venue
    camera: Camera
    sharp: Bytes
    blurred: Bytes
    grain: NDArray[np.int8]
    props: tuple[Prop, ...]


def open_view(
    camera: Camera, pitch: PitchTemplate, seed: int, settings: RenderingSettings | None = None
) -> View:
    """Return a static camera's view of a stadium, about a second for 1920 x 1080.

    Args:
        camera: a single camera.
        pitch: the painted pitch.
        seed: of the stadium's look and the sensor's noise.
        settings: the defaults if None.
    """
    venue = build_venue(pitch, seed, settings or RenderingSettings())
    seen = paint_empty(venue, camera)
    venue.fogged(seen.color, seen.distance)
    light = np.asarray(255.0 * venue.settings.exposure * seen.color, dtype=np.float32)
    blurred = through_lens(light, venue.settings)
    return View(
        venue,
        camera,
        to_bytes(light),
        to_bytes(blurred),
        sensor_grain(venue, camera),
        goals(pitch),
    )


def render_frame(
    view: View,
    cast: Cast,
    opened: Surfaces,
    closed: Surfaces | None = None,
    *,
    frame: int = 0,
    props: Sequence[Prop] = (),
) -> RenderedFrame:
    """Return one image of people; the same arguments give the same bytes.

    Args:
        view: a static camera.
        cast: the people.
        opened: their surfaces when the shutter opens.
        closed: their surfaces when it closes; None = no motion.
        frame: seeds the noise of this image of a clip.
        props: things in addition to the goals.
    """
    moment = Moment(cast, opened, closed or opened, [*view.props, *props])
    return expose(
        view.venue,
        view.camera,
        view.sharp.copy(),
        view.blurred.copy(),
        view.grain,
        moment,
        frame,
    )
