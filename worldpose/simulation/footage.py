"""Frames and videos of a scene, with the boxes and masks of all people."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image, Singles
from worldpose.formats import write_archive
from worldpose.geometry import Camera
from worldpose.ingest.footage import write_still
from worldpose.pitch import PitchTemplate
from worldpose.simulation.cast import (
    BALL,
    Cast,
    Prop,
    assign_roles,
    ball,
    dress_people,
    goals,
    place_bystanders,
)
from worldpose.simulation.image_formation import (
    Moment,
    RenderedFrame,
    blur_by_lens,
    expose,
    sensor_grain,
    to_bytes,
)
from worldpose.simulation.mannequins import Surfaces
from worldpose.simulation.renderer import film_broadcast
from worldpose.simulation.scene import Scene
from worldpose.simulation.settings import RenderingSettings, Scenario
from worldpose.simulation.venues import Venue, build_venue, paint_empty
from worldpose.video import write_video


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
    sharp: Image
    blurred: Image
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
    venue.add_fog(seen.color, seen.distance)
    light = np.asarray(255.0 * venue.settings.exposure * seen.color, dtype=np.float32)
    blurred = blur_by_lens(light, venue.settings)
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


Advance = Callable[[str, int, int], None]

AT_ONCE: Final = 4
"""Maximum number of cameras filmed at a time: each holds its empty stadium and encoder frames."""


def film_scene(
    scene: Scene,
    scenario: Scenario,
    seed: int,
    folder: Path,
    *,
    clip_id: str,
    stills: bool = False,
    masks: bool = False,
    advance: Advance | None = None,
) -> None:
    """Write the videos of all cameras into a match folder, frame by frame.

    In addition to videos/<camera>.mp4 and broadcast/<clip>.mp4, for every camera or clip:

    - reference/boxes/<name>.npz: `boxes` (frames, persons, 4) left, top, right, bottom of every
      person's outline [px], occluded parts included; `visible` (frames, persons), the unoccluded
      share of the outline's part in the image;
    - with `stills`, stills/<camera>.png, its first frame before encoding;
    - with `masks`, reference/masks/<name>/<frame>.png, 8 bit: person + 1, 0 for no person.

    Args:
        scene: the scene to film.
        scenario: its look, and its frame rate.
        seed: of the stadium, kits and noise.
        folder: of the match.
        clip_id: names the broadcast camera's files.
        stills: write stills, too.
        masks: write masks, too.
        advance: called with the camera or clip, its finished frames and its number of frames.
    """
    stage = _FilmSet(scene, scenario, seed)
    names = [*scene.cameras, *([] if scene.broadcast is None else [clip_id])]

    def report_progress(name: str, frames: int, done: int) -> None:
        if advance is not None:
            advance(name, done, frames)

    def film(name: str) -> None:
        frames = stage.broadcast() if name == clip_id else stage.static(name)
        part = "broadcast" if name == clip_id else "videos"
        file = folder / part / f"{name}.mp4"
        file.parent.mkdir(exist_ok=True)
        still = folder / "stills" / f"{name}.png" if stills and name != clip_id else None
        mask = folder / "reference" / "masks" / name if masks else None
        kept = _Labels(still, mask, partial(report_progress, name, len(stage.times) - 1))
        write_video(file, kept.collect_labels(frames), scenario.fps)
        boxes = folder / "reference" / "boxes" / f"{name}.npz"
        write_archive(boxes, {"boxes": np.array(kept.boxes), "visible": np.array(kept.visible)})

    with ThreadPoolExecutor(min(AT_ONCE, os.cpu_count() or 1)) as pool:
        for _ in pool.map(film, names):
            pass


class _FilmSet:
    """A dressed scene ready for filming."""

    def __init__(self, scene: Scene, scenario: Scenario, seed: int) -> None:
        self.scene, self.scenario, self.seed = scene, scenario, seed
        self.pitch = PitchTemplate.from_spec(scenario.pitch)
        # One more than there are frames: positions of people while the last frame's shutter is
        # open.
        self.times = np.arange(len(scene.truth.frames) + 1) / scenario.fps
        self.poses = scene.crowd.poses(self.times)
        roles = assign_roles(scenario.crowd, len(scene.crowd.paths))
        betas = np.array([body.figure.betas for body in scene.crowd.bodies]).reshape(-1, 10)
        self.cast: Cast = dress_people(betas, roles, seed, scenario.look.patterns)
        self.bystanders = place_bystanders(self.pitch, scenario.look.bystanders, seed)
        self.ball = ball() if scenario.crowd.movement == "football" else None

    def static(self, name: str) -> Iterator[RenderedFrame]:
        """Yield the frames of a static camera."""
        view = open_view(self.scene.cameras[name], self.pitch, self.seed, self.scenario.look)
        clock_offset = self.scene.clocks[name] / self.scenario.fps
        for frame, moment in enumerate(self._moments(clock_offset)):
            yield render_frame(
                view, self.cast, moment.opened, moment.closed, frame=frame, props=moment.props
            )

    def broadcast(self) -> Iterator[RenderedFrame]:
        """Yield the frames of the broadcast camera."""
        assert self.scene.broadcast is not None  # callers check this
        venue = build_venue(self.pitch, self.seed, self.scenario.look)
        standing = goals(self.pitch)
        moments = (
            Moment(each.cast, each.opened, each.closed, [*standing, *each.props])
            for each in self._moments(0.0)
        )
        return film_broadcast(self.scene.broadcast, venue, moments)

    def _moments(self, clock_offset: float) -> Iterator[Moment]:
        """Yield the content of every frame of a camera with a clock offset [s]."""
        times = self.times + clock_offset
        poses = self.poses if clock_offset == 0.0 else self.scene.crowd.poses(times)
        share = self.scenario.look.shutter * self.scenario.fps
        surfaces = (self.cast.pose(poses[:, k]) for k in range(len(times)))
        for time, (opened, following) in zip(times, pairwise(surfaces), strict=False):
            closed = opened.toward(following, share) if share > 0.0 else opened
            yield Moment(self.cast, opened, closed, self._props(float(time)))

    def _props(self, time: float) -> tuple[Prop, ...]:
        if self.ball is None:
            return self.bystanders
        crowd = self.scene.crowd
        x, y = (float(np.interp(time, crowd.action_times, axis)) for axis in crowd.action.T)
        at = np.array([x, y, BALL + float(self.pitch.height(x, y))])
        return (*self.bystanders, self.ball.at(at))


class _Labels:
    """Boxes, stills and masks kept from a camera's frames."""

    def __init__(
        self, still: Path | None, masks: Path | None, advance: Callable[[int], None]
    ) -> None:
        self.still, self.masks, self.advance = still, masks, advance
        self.boxes: list[Singles] = []
        self.visible: list[Singles] = []
        if masks is not None:
            masks.mkdir(parents=True)

    def collect_labels(self, frames: Iterator[RenderedFrame]) -> Iterator[NDArray[np.uint8]]:
        """Yield the images of frames."""
        for number, frame in enumerate(frames):
            self.boxes.append(frame.boxes.astype(np.float32))
            self.visible.append(frame.visible.astype(np.float32))
            if self.still is not None and number == 0:
                write_still(self.still, frame.image)
            if self.masks is not None:
                file = self.masks / f"{number:06d}.png"
                cv2.imwrite(str(file), (frame.person_ids + 1).astype(np.uint8))
            yield frame.image
            self.advance(number + 1)
