"""Synthetic match folders: the inputs that a user would supply, rendered videos, ground truth."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image, Singles
from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.body.body_file import OPEN_BODY, load_open_body
from worldpose.body.model import BodyParameters
from worldpose.formats.archives import write_archive
from worldpose.formats.joints_file import write_poses
from worldpose.formats.release_cameras import write_moving_camera
from worldpose.ingest.footage import write_still
from worldpose.ingest.writing import MatchAnnotations, write_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.annotations import click_key_frames
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies
from worldpose.simulation.mannequins import Cast, assign_roles, dress_people
from worldpose.simulation.paths import Clip, GroundPath
from worldpose.simulation.recordings import read_clip, read_trajectories
from worldpose.simulation.reference import CLIP_ID, write_reference
from worldpose.simulation.renderer import (
    Moment,
    RenderedFrame,
    film_broadcast,
    open_view,
    render_frame,
)
from worldpose.simulation.scene import Scene, broadcast_id, simulate_scene
from worldpose.simulation.settings import CalibrationErrors, Scenario
from worldpose.simulation.venues import build_venue
from worldpose.video.files import write_video

Advance = Callable[[str, int, int], None]


def _film_scene(
    stage: _FilmSet, folder: Path, options: MatchOptions, advance: Advance | None
) -> None:
    """Write the videos of all cameras into a match folder, frame by frame.

    docs/explanation/simulation.md describes the files.
    """
    # Maximum number of cameras filmed at a time: each holds its empty stadium and encoder
    # frames.
    at_once = 4

    def film(name: str) -> None:
        part = "broadcast" if name in stage.scene.broadcast else "videos"
        file = folder / part / f"{name}.mp4"
        file.parent.mkdir(exist_ok=True)
        labelled = _keep_labels(stage, name, folder, options, advance)
        write_video(file, labelled, stage.fps(name))

    names = [*stage.scene.cameras, *stage.scene.broadcast]
    with ThreadPoolExecutor(min(at_once, os.cpu_count() or 1)) as pool:
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

    def fps(self, name: str) -> float:
        """Return the frame rate of a camera [1/s]."""
        view = self.scene.broadcast.get(name)
        return self.scenario.fps if view is None else view.fps

    def count(self, name: str) -> int:
        """Return the number of images of a camera."""
        view = self.scene.broadcast.get(name)
        return len(self.scene.truth.frames) if view is None else len(view.times)

    @functools.cached_property
    def poses(self) -> BodyParameters:
        """Return the bodies (persons, times)."""
        return self.scene.crowd.poses(self.times)

    @functools.cached_property
    def cast(self) -> Cast:
        """Return the people in their clothes."""
        crowd, look = self.scene.crowd, self.scenario.look
        roles = assign_roles(self.scenario.crowd, len(crowd.paths))
        betas = np.array([body.betas for body in crowd.bodies]).reshape(-1, 10)
        return dress_people(betas, roles, self.seed, look.patterns)

    def film(self, name: str, frames: int | None = None) -> Iterator[RenderedFrame]:
        """Yield the first frames of a static camera or a broadcast view, by default all."""
        fps = self.fps(name)
        count = self.count(name) if frames is None else frames
        late = self.scene.clocks.get(name, 0.0) / fps
        moments = self._moments(np.arange(count + 1) / fps + late, fps)
        if name in self.scene.broadcast:
            venue = build_venue(self.pitch, self.seed, self.scenario.look)
            yield from film_broadcast(self.scene.broadcast[name].camera, venue, moments)
            return
        view = open_view(self.scene.cameras[name], self.pitch, self.seed, self.scenario.look)
        for frame, each in enumerate(moments):
            yield render_frame(view, each.cast, each.opened, each.closed, frame=frame)

    def _moments(self, times: Floats, fps: float) -> Iterator[Moment]:
        """Yield the people in every frame of a camera, from its times and that of one more [s]."""
        is_usual = np.array_equal(times, self.times[: len(times)])
        poses = self.poses if is_usual else self.scene.crowd.poses(times)
        share = self.scenario.look.exposure_s * fps
        surfaces = (self.cast.pose(poses[:, k]) for k in range(len(times)))
        for opened, following in pairwise(surfaces):
            closed = opened.toward(following, share) if share > 0.0 else opened
            yield Moment(self.cast, opened, closed)


def _keep_labels(
    stage: _FilmSet, name: str, folder: Path, options: MatchOptions, advance: Advance | None
) -> Iterator[Image]:
    """Yield a camera's images, and write its still, masks and boxes."""
    boxes, visible = list[Singles](), list[Singles]()
    masks = folder / "reference" / "masks" / name
    if options.masks:
        masks.mkdir(parents=True)
    for number, frame in enumerate(stage.film(name)):
        boxes.append(frame.boxes.astype(np.float32))
        visible.append(frame.visible.astype(np.float32))
        if options.stills and name in stage.scene.cameras and number == 0:
            write_still(folder / "stills" / f"{name}.png", frame.image)
        if options.masks:
            file = masks / f"{number:06d}.png"
            cv2.imwrite(str(file), (frame.person_ids + 1).astype(np.uint8))
        yield frame.image
        if advance is not None:
            advance(name, number + 1, stage.count(name))
    file = folder / "reference" / "boxes" / f"{name}.npz"
    write_archive(file, {"boxes": np.array(boxes), "visible": np.array(visible)})


@dataclass(frozen=True)
class MatchOptions:
    """Changes of a simulated match to its scenario, and the files to write."""

    duration: float | None = None
    """[s], instead of the scenario's."""
    cameras: int | None = None
    """Number of static cameras, instead of the scenario's."""
    players: int | None = None
    """Number of people, instead of the scenario's."""
    trajectories: Path | None = None
    """Tracking data (`read_trajectories`) that drives the people instead; the clip ends with it."""
    mocap: Path | None = None
    """Motion capture (`worldpose.simulation.recordings.read_clip`) that one person plays."""
    calibrated: bool = False
    """Write the true static cameras as calibration.toml; without, the folder has such a file only
    if the scenario has calibration errors."""
    stills: bool = True
    """Add one image of every static camera, about a second each."""
    video: bool = True
    """If the scenario has key frames, add the broadcast camera's video, about 0.1 s per frame,
    annotated key frames, and bodies from a simulated monocular method (`estimates/`)."""
    render: bool = False
    """Film all cameras, and write no detections, so that pixels are the only input."""
    masks: bool = False
    """Add person masks of all filmed frames."""


def simulate_match(
    scenario: Scenario,
    seed: int,
    out: Path,
    options: MatchOptions | None = None,
    *,
    advance: Advance | None = None,
) -> MatchSpec:
    """Write a synthetic match folder with its ground truth; the same arguments give the same bytes.

    docs/explanation/simulation.md describes the files.

    `out` is absent or an empty folder; the write is atomic. `advance` receives the filming's
    progress.

    Returns:
        The match's match.yaml. Its id names scenario, seed and overrides of the scenario.

    Raises:
        InputError: `out` holds files, or the trajectories or the capture cannot be used.
    """
    options = options or MatchOptions()
    scenario, changes, driven, clip = _apply_options(scenario, options)
    scene = simulate_scene(scenario, seed, driven=driven, clip=clip)
    given = scene.given if options.calibrated or scenario.calibration != CalibrationErrors() else {}
    stage = _FilmSet(scene, scenario, seed)
    images = _draw_stills(stage) if options.stills and not options.render else {}
    spec = _describe_match(scenario, scene, "-".join([scenario.name, str(seed), *changes]), options)
    write_match(
        out,
        spec,
        calibrations={name: camera.to_calibration(name) for name, camera in given.items()},
        observations={} if options.render else scene.observations,
        pitch=scene.surveyed,
        annotations=MatchAnnotations(
            clicked={name: clicks.markings for name, clicks in scene.clicks.items()},
            key_frames=_key_frames(scenario, scene, seed)
            if options.video or options.render
            else {},
        ),
        stills=images,
        further=lambda folder: _write_further(stage, folder, options, advance),
    )
    return spec


def _describe_match(
    scenario: Scenario, scene: Scene, match_id: str, options: MatchOptions
) -> MatchSpec:
    width, height = scenario.rig.image_size_px
    stills = {name: f"stills/{name}.png" if options.stills else None for name in scene.cameras}
    specs = [
        CameraSpec(id=name, width=width, height=height, still=still)
        for name, still in stills.items()
    ]
    moving = []
    for number, view in enumerate(scene.broadcast.values()):
        wide, high = view.camera.image_size.reshape(-1, 2)[0].tolist()
        fps = None if view.fps == scenario.fps else view.fps
        name = broadcast_id(number)
        moving.append(CameraSpec(id=name, kind="broadcast", width=wide, height=high, fps=fps))
    names = tuple(camera.id for camera in moving)
    broadcast = names if len(names) > 1 else next(iter(names), None)
    return MatchSpec(
        match_id=match_id,
        fps=scenario.fps,
        cameras=(*specs, *moving),
        clips=(ClipSpec(id=CLIP_ID, frame_count=len(scene.truth.frames), broadcast=broadcast),),
    )


def _write_further(
    stage: _FilmSet, folder: Path, options: MatchOptions, advance: Advance | None
) -> None:
    """Write ground truth, videos, and bodies of a monocular method."""
    scene, scenario = stage.scene, stage.scenario
    _write_truth(folder / "reference", scenario, scene, detected=not options.render)
    if options.render:
        _film_scene(stage, folder, options, advance)
        return
    is_filmed = scenario.key_frames and options.video
    for number, (name, view) in enumerate(scene.broadcast.items() if is_filmed else ()):
        video = folder / "broadcast" / f"{name}.mp4"
        video.parent.mkdir(exist_ok=True)
        write_video(video, (frame.image for frame in stage.film(name)), view.fps)
        poses = scene.poses if view.fps == scenario.fps else scene.crowd.poses(view.times)
        given = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
        bodies = BodyParameters(*(np.swapaxes(values, 0, 1) for values in given))
        rng = np.random.default_rng([stage.seed, 5, number][: 3 if number else 2])
        found = estimate_bodies(
            load_open_body(), bodies, view.camera, view.fps, MonocularErrors(), rng
        )
        write_archive(folder / "estimates" / f"{name}.npz", found)


def _apply_options(
    scenario: Scenario, options: MatchOptions
) -> tuple[Scenario, list[str], list[GroundPath] | None, Clip | None]:
    """Return the changed scenario, names of the changes, tracked paths, and motion capture."""
    changes, updates, driven, clip = [], dict[str, object](), None, None
    duration = scenario.duration
    if options.duration is not None:
        duration = options.duration
        changes.append(f"{duration:g}s")
    if options.cameras is not None:
        updates["rig"] = scenario.rig.model_copy(update={"cameras": options.cameras})
        changes.append(f"{options.cameras}cameras")
    if options.players is not None:
        updates["crowd"] = scenario.crowd.model_copy(update={"people": options.players})
        changes.append(f"{options.players}players")
    if options.trajectories is not None:
        driven, duration = read_trajectories(options.trajectories, duration, options.players)
        changes.append(f"tracks{_digest(options.trajectories)}")
    if options.mocap is not None:
        clip = read_clip(options.mocap)
        changes.append(f"mocap{_digest(options.mocap)}")
    if options.calibrated:
        updates["calibration"] = CalibrationErrors()
        changes.append("calibrated")
    updates["duration"] = duration
    return scenario.model_copy(update=updates), changes, driven, clip


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:8]


def _draw_stills(stage: _FilmSet) -> dict[str, Image]:
    """Return the first image of every static camera."""
    names = list(stage.scene.cameras)
    with ThreadPoolExecutor() as pool:  # the renderer's kernels release the GIL
        drawn = pool.map(lambda name: next(stage.film(name, 1)).image, names)
        return dict(zip(names, drawn, strict=True))


def _key_frames(scenario: Scenario, scene: Scene, seed: int) -> dict[str, KeyFrames]:
    """Return the annotated key frames of the broadcast cameras' videos, if there are any."""
    if not scenario.key_frames:
        return {}
    painted, rng = PitchTemplate.from_spec(scenario.pitch), np.random.default_rng([seed, 4])
    clicked = {}
    for name, view in scene.broadcast.items():
        is_usual = view.fps == scenario.fps
        people = scene.truth.joints if is_usual else scene.crowd.joints(view.times)
        clicked[name] = click_key_frames(
            view.camera, painted, people, scenario.clicks, scenario.key_frames, rng
        )
    return clicked


def _write_truth(folder: Path, scenario: Scenario, scene: Scene, *, detected: bool) -> None:
    """Write the ground truth of a scene, with or without its detections' persons."""
    points = {n: tuple(p) for n, p in PitchTemplate.from_spec(scenario.pitch).points.items()}
    clicks = {
        name: {"wrong": dict(each.wrong), "clustered": each.clustered}
        for name, each in scene.clicks.items()
    }
    write_reference(
        folder,
        scene.truth,
        scene.defined if detected else None,
        scene.cameras,
        scene.identities if detected else {},
        {"clocks": scene.clocks, "clicks": clicks},
        scenario.pitch.model_copy(update={"points": points}),
    )
    write_poses(folder / "poses" / f"{CLIP_ID}.npz", scene.poses, OPEN_BODY)
    for name, view in scene.broadcast.items():
        write_moving_camera(folder / "cameras" / f"{name}.npz", view.camera[view.number])
