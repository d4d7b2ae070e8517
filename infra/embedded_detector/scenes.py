"""Rendered scenes with labels: people in many kits, stadiums, lights and lenses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.pitch import PitchSpec
from worldpose.body.model import BodyParameters
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.crowd import Crowd, gather
from worldpose.simulation.mannequins import Surfaces, assign_roles, dress_people
from worldpose.simulation.renderer import Moment, RenderedFrame, open_view
from worldpose.simulation.scene import place_camera
from worldpose.simulation.settings import (
    PATTERNS,
    CrowdSettings,
    RenderingSettings,
    RigSettings,
    Scenario,
)
from worldpose.training.labels import LabelledPicture, read_labels, write_labels

HIDDEN = 0.3
"""People with a smaller visible share are ignored [1]."""
SIZE = (1920, 1080)


@dataclass(frozen=True)
class SceneKind:
    """Distribution of a set of scenes.

    Attributes:
        first_seed: of its stadiums, kits and people; sets do not share any.
        patterns: of shirts.
        heights: of people [m].
        person_height: of people in the middle of the images [px].
        hazy: share of scenes with fog [1].
        fog: maximum extinction [1/m].
        exposure: logarithm of the images' brightness [1].
        blur: of the lens [px].
        noise: of the sensor [levels of 255].
        movements: probabilities of match play, a corner, wandering people, and crossing paths [1].
    """

    first_seed: int
    patterns: tuple[str, ...]
    heights: tuple[float, float]
    person_height: tuple[float, float] = (36.0, 140.0)
    hazy: float = 0.15
    fog: float = 0.006
    exposure: tuple[float, float] = (-0.35, 0.3)
    blur: tuple[float, float] = (0.4, 1.3)
    noise: tuple[float, float] = (0.5, 5.0)
    movements: tuple[float, float, float, float] = (0.3, 0.2, 0.35, 0.15)


TRAINING = SceneKind(
    10_000, tuple(p for p in PATTERNS if p not in ("chequers", "sash")), (1.66, 1.97)
)
VARIETY = replace(TRAINING, first_seed=50_000)
"""More stadiums, kits and people, in fewer images each."""
CROWDS = replace(TRAINING, first_seed=60_000, movements=(0.1, 0.7, 0.1, 0.1))
"""Mostly corners: people who occlude one another."""
FAR = replace(
    TRAINING, first_seed=70_000, person_height=(14.0, 40.0), movements=(0.7, 0.1, 0.1, 0.1)
)
"""Small people in match play."""
CHECKING = SceneKind(20_000, TRAINING.patterns, TRAINING.heights)
HELD_OUT = SceneKind(30_000, PATTERNS, (1.60, 2.02))
"""Kits with patterns outside the training data, and shorter and taller people."""
SHIFTED = SceneKind(
    40_000, ("chequers", "sash"), (1.60, 2.02), person_height=(34.0, 48.0), hazy=1.0, fog=0.02
)
"""A change of domain: other kits, fog, lower zoom."""


def render_set(
    folder: Path, kind: SceneKind, scenes: int, *, views: int = 4, frames: int = 2
) -> Iterator[str]:
    """Write scenes, each a folder of images with labels.json; yield a line for each.

    Existing labels are kept.
    """
    for seed in range(kind.first_seed, kind.first_seed + scenes):
        labels = folder / str(seed) / "labels.json"
        if not labels.exists():
            labels.parent.mkdir(parents=True, exist_ok=True)
            write_labels(labels, _scene(labels.parent, kind, seed, views, frames), SIZE)
        yield f"{folder.name}: scene {seed - kind.first_seed + 1} of {scenes}"


def read_set(folder: Path) -> list[LabelledPicture]:
    """Return the images of all scenes of a folder."""
    scenes = sorted(folder.glob("*/labels.json"))
    return [picture for labels in scenes for picture in read_labels(labels)]


def _scene(
    folder: Path, kind: SceneKind, seed: int, views: int, frames: int
) -> list[LabelledPicture]:
    return [save(folder, each) for each in render_scene(kind, seed, views=views, frames=frames)]


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of a scene with its truth.

    Attributes:
        name: file name.
        rendered: the image with its pixel labels.
        camera: the camera that took it.
        joints: (persons, 17, 3) [m], world.
        poses: bodies of the people (persons,).
        surfaces: their clothed surfaces.
    """

    name: str
    rendered: RenderedFrame
    camera: Camera
    joints: NDArray[np.float64]
    poses: BodyParameters
    surfaces: Surfaces


def save(folder: Path, shot: Shot) -> LabelledPicture:
    """Write the image of a shot into a folder, and return it with the labels of its joints."""
    path = folder / shot.name
    cv2.imwrite(str(path), shot.rendered.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    pixels = shot.camera.project(shot.joints.reshape(-1, 3)).reshape(-1, 17, 2)
    visible = np.where(find_visible(shot.rendered.person_ids, pixels), 2, 1)
    visible[~np.isfinite(pixels).all(axis=-1)] = 0
    return label(path, shot.rendered, pixels, visible)


def render_scene(kind: SceneKind, seed: int, *, views: int, frames: int) -> Iterator[Shot]:
    """Yield the images of a scene: all moments of one view after the other."""
    rng = np.random.default_rng(seed)
    scenario = _scenario(kind, rng)
    pitch = PitchTemplate.from_spec(scenario.pitch)
    crowd = gather(scenario, pitch, np.random.SeedSequence(seed))
    times = np.sort(rng.uniform(0.2, scenario.duration - 0.2, frames))
    settings = _draw_rendering(kind, rng)
    poses, later = crowd.poses(times), crowd.poses(times + settings.exposure_s)
    joints = crowd.joints(times)
    roles = assign_roles(scenario.crowd, len(crowd.paths))
    cast = dress_people(poses.betas[:, 0], roles, seed, settings.patterns)
    for index in range(views):
        camera = _camera(kind, scenario.pitch, crowd, joints[0], rng)
        view = open_view(camera, pitch, seed, settings)
        for frame in range(frames):
            surfaces = cast.pose(poses[:, frame])
            moment = Moment(cast, surfaces, cast.pose(later[:, frame]))
            rendered = view.expose(moment, frame)
            name = f"{index}_{frame}.jpg"
            yield Shot(name, rendered, camera, joints[frame], poses[:, frame], surfaces)


def label(
    path: Path, rendered: RenderedFrame, pixels: NDArray[np.float64], visible: NDArray[np.int64]
) -> LabelledPicture:
    """Return the labels of a rendered frame, of people whose box lies in it.

    Args:
        path: of its image.
        rendered: the image with its pixel labels.
        pixels: (persons, points, 2) [px].
        visible: (persons, points): 2 visible, 1 occluded, 0 not labelled.
    """
    height, width = rendered.image.shape[:2]
    limits = np.array([width, height, width, height]) - 0.5
    boxes = np.clip(rendered.boxes, -0.5, limits)
    sides = boxes[:, 2:] - boxes[:, :2]
    there = np.isfinite(boxes).all(axis=1) & (np.nan_to_num(sides) > 1.0).all(axis=1)
    return LabelledPicture(
        path=path,
        boxes=boxes[there],
        keypoints=pixels[there],
        visible=visible[there].astype(np.int8),
        ignored=rendered.visible[there] < HIDDEN,
    )


def find_visible(person_ids: NDArray[np.int16], pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether a person fills a pixel near each of its points (persons, points)."""
    height, width = person_ids.shape
    shown = np.zeros(pixels.shape[:2], dtype=bool)
    # Distorted points far outside may overflow an integer.
    at = np.clip(np.nan_to_num(np.round(pixels), nan=-9.0), -9.0, 2.0 * width + 2.0 * height)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            x, y = (at + np.array([across, down])).swapaxes(0, -1).swapaxes(1, -1).astype(int)
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            who = person_ids[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
            shown |= inside & (who == np.arange(len(pixels))[:, None])
    return shown


def _scenario(kind: SceneKind, rng: np.random.Generator) -> Scenario:
    movement = str(rng.choice(["football", "corner", "wander", "crossing"], p=kind.movements))
    people = {"football": 25, "corner": 18}.get(movement, int(rng.integers(6, 17)))
    side = float(rng.uniform(10.0, 26.0))
    center = (
        (45.0, 0.0)
        if movement == "corner"
        else (float(rng.uniform(-44, 44)), float(rng.uniform(-26, 26)))
    )
    crowd = CrowdSettings(
        people=people,
        movement=movement,
        officials=3 if movement == "football" else 0,
        area_center_m=center,
        area_size_m=(11.0, 15.0) if movement == "corner" else (side, 0.7 * side),
        speed_m_s=(float(rng.uniform(-0.8, 1.0)), float(rng.uniform(3.5, 6.5))),
        personal_space_m=float(rng.uniform(0.8, 1.6)),
        height_m=kind.heights,
    )
    return Scenario(name="scene", about="To learn from.", duration=4.0, crowd=crowd)


def _draw_rendering(kind: SceneKind, rng: np.random.Generator) -> RenderingSettings:
    return RenderingSettings(
        stripes=float(rng.uniform(0.0, 0.3)),
        paint=float(rng.uniform(0.7, 1.0)),
        light="sun" if rng.random() < 0.55 else "floodlights",
        stand_shadow=float(rng.choice([0.0, 0.3, 0.45, 0.6])),
        fog_per_m=float(rng.uniform(0.4, 1.0) * kind.fog) if rng.random() < kind.hazy else 0.0,
        brightness=float(np.exp(rng.uniform(*kind.exposure))),
        patterns=kind.patterns,
        blur_px=float(rng.uniform(*kind.blur)),
        noise=float(rng.uniform(*kind.noise)),
    )


def _camera(
    kind: SceneKind,
    pitch: PitchSpec,
    crowd: Crowd,
    joints: NDArray[np.float64],
    rng: np.random.Generator,
) -> Camera:
    """Return a camera off the pitch that looks at or past a person."""
    target = joints[int(rng.integers(len(joints))), 11] + [*rng.uniform(-3.0, 3.0, 2), 0.0]
    target = np.clip(target, [-50.0, -32.0, 0.0], [50.0, 32.0, 0.0])
    rig = RigSettings(
        person_height_px=float(np.exp(rng.uniform(*np.log(kind.person_height)))),
        height_m=(7.0, 30.0),
        image_size_px=SIZE,
    )
    return place_camera(rig, int(rng.integers(1000)), target, pitch, rng)
