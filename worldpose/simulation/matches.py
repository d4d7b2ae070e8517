"""Synthetic match folders: the inputs that a user would supply, rendered videos, ground truth."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image, Singles
from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.body.body_file import OPEN_BODY
from worldpose.formats.archives import write_archive
from worldpose.formats.calibration_files import write_calibration_toml
from worldpose.formats.challenge import write_moving_camera, write_static_camera
from worldpose.formats.joints_file import write_joints, write_poses
from worldpose.geometry.cameras import Camera
from worldpose.ingest.footage import write_still
from worldpose.ingest.writing import MatchAnnotations, write_match
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.annotations import click_key_frames
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
from worldpose.simulation.detector_errors import write_estimates
from worldpose.simulation.image_formation import (
    Moment,
    RenderedFrame,
    blur_by_lens,
    expose,
    sensor_grain,
    to_bytes,
)
from worldpose.simulation.mannequins import Surfaces
from worldpose.simulation.paths import Clip, GroundPath
from worldpose.simulation.recordings import read_clip, read_trajectories
from worldpose.simulation.renderer import film_broadcast, render_broadcast, render_pitch
from worldpose.simulation.scene import Scene, simulate_scene
from worldpose.simulation.settings import CalibrationErrors, RenderingSettings, Scenario
from worldpose.simulation.venues import Venue, build_venue, paint_empty
from worldpose.video.files import write_video


@dataclass(frozen=True, eq=False)
class View:
    """A static camera before an empty stadium.

    Attributes:
        venue: the stadium.
        camera: a single camera.
        sharp: (height, width, 3) RGB, before the lens; without goals.
        blurred: the same image through the lens.
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
        seed: seed of the stadium's look and the sensor's noise.
        settings: the defaults if None.
    """
    venue = build_venue(pitch, seed, settings or RenderingSettings())
    seen = paint_empty(venue, camera)
    venue.add_fog(seen.color, seen.distance)
    light = np.asarray(255.0 * venue.settings.brightness * seen.color, dtype=np.float32)
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
        frame: index of the image, which seeds its noise.
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
    stills: bool,
    masks: bool,
    advance: Advance | None,
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
        seed: seed of the stadium, kits and noise.
        folder: folder of the match.
        stills: write stills, too.
        masks: write masks, too.
        advance: called with the camera or clip, its finished frames and its number of frames.
    """
    stage = _FilmSet(scene, scenario, seed)
    names = [*scene.cameras, *([] if scene.broadcast is None else [CLIP_ID])]

    def report_progress(name: str, frames: int, done: int) -> None:
        if advance is not None:
            advance(name, done, frames)

    def film(name: str) -> None:
        frames = stage.broadcast() if name == CLIP_ID else stage.static(name)
        part = "broadcast" if name == CLIP_ID else "videos"
        file = folder / part / f"{name}.mp4"
        file.parent.mkdir(exist_ok=True)
        still = folder / "stills" / f"{name}.png" if stills and name != CLIP_ID else None
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
        share = self.scenario.look.exposure_s * self.scenario.fps
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


CLIP_ID = "clip"
BROADCAST_ID = "broadcast"


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
    """Film all cameras (`worldpose.simulation.matches.film_scene`), and write no detections, so
    that pixels are the only input. Stills are first frames."""
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

    In addition to the files of a match folder to be calibrated (match.yaml, pitch.json,
    detections/, annotations/, stills/) it holds, under reference/:

    - joints.npz (`worldpose.formats.write_joints`), and defined_joints.npz, the same joints where
      the detector takes them to be;
    - poses/clip.npz, the bodies that these joints are keypoints of, in the WorldPose release's
      format: betas (N, 10), global_orient (N, T, 3), body_pose (N, T, 69), transl (N, T, 3) in
      single precision, and the name of the `body_model`;
    - calibration.toml and cameras/<camera>.npz (`worldpose.formats.write_static_camera`) and, with
      one row per frame, cameras/clip.npz of the broadcast camera;
    - pitch.json of the painted pitch;
    - clicks.json: of every static camera, `wrong` clicks (`Clicks.wrong`), and whether they are
      `clustered` in one part of the image;
    - identities/<camera or clip>.npz: `frame` (frames,) int64, `person` (frames, detections) int16,
      the index into the joints file's `person_ids` of every detection, -1 for false positives and
      padding, and `displaced` (frames, detections, 17) uint8, keypoints with gross errors;
    - clocks.json: offset of each static camera behind its stated clock, in frames.

    Args:
        scenario: the scenario to simulate.
        seed: seed from 0.
        out: absent or an empty folder; the write is atomic.
        options: changes of the scenario, and which files to write; the defaults if None.
        advance: receives the filming's progress.

    Returns:
        The match's match.yaml. Its id names scenario, seed and overrides of the scenario.

    Raises:
        InputError: `out` holds files, or the trajectories or the capture cannot be used.
    """
    options = options or MatchOptions()
    scenario, changes, driven, clip = _apply_options(scenario, options)
    scene = simulate_scene(scenario, seed, clip_id=CLIP_ID, driven=driven, clip=clip)
    given = scene.given if options.calibrated or scenario.calibration != CalibrationErrors() else {}
    images = _stills(scenario, scene, seed) if options.stills and not options.render else {}
    width, height = scenario.rig.image_size_px
    specs = [
        CameraSpec(
            id=name,
            width=width,
            height=height,
            still=f"stills/{name}.png" if options.stills else None,
        )
        for name in scene.cameras
    ]
    if scene.broadcast is not None:
        specs.append(CameraSpec(id=BROADCAST_ID, kind="broadcast", width=width, height=height))
    spec = MatchSpec(
        match_id="-".join([scenario.name, str(seed), *changes]),
        fps=scenario.fps,
        cameras=tuple(specs),
        clips=(
            ClipSpec(
                id=CLIP_ID,
                frame_count=len(scene.truth.frames),
                broadcast=None if scene.broadcast is None else BROADCAST_ID,
            ),
        ),
    )

    def write_further(folder: Path) -> None:
        write_references(folder / "reference", scenario, scene, detected=not options.render)
        if options.render:
            film_scene(
                scene,
                scenario,
                seed,
                folder,
                stills=options.stills,
                masks=options.masks,
                advance=advance,
            )
        elif scene.broadcast is not None and scenario.key_frames and options.video:
            _write_broadcast(folder, scenario, scene.broadcast, scene, seed)

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
        further=write_further,
    )
    return spec


def _apply_options(
    scenario: Scenario, options: MatchOptions
) -> tuple[Scenario, list[str], list[GroundPath] | None, Clip | None]:
    """Return the changed scenario, names of the changes, tracked paths, and motion capture."""
    changes = []
    if options.duration is not None:
        scenario = scenario.model_copy(update={"duration": options.duration})
        changes.append(f"{options.duration:g}s")
    if options.cameras is not None:
        rig = scenario.rig.model_copy(update={"cameras": options.cameras})
        scenario = scenario.model_copy(update={"rig": rig})
        changes.append(f"{options.cameras}cameras")
    if options.players is not None:
        crowd = scenario.crowd.model_copy(update={"people": options.players})
        scenario = scenario.model_copy(update={"crowd": crowd})
        changes.append(f"{options.players}players")
    driven = None
    if options.trajectories is not None:
        driven, length = read_trajectories(
            options.trajectories, scenario.duration, max_people=options.players
        )
        scenario = scenario.model_copy(update={"duration": length})
        changes.append(f"tracks{hashlib.sha256(options.trajectories.read_bytes()).hexdigest()[:8]}")
    clip = None
    if options.mocap is not None:
        clip = read_clip(options.mocap)
        changes.append(f"mocap{hashlib.sha256(options.mocap.read_bytes()).hexdigest()[:8]}")
    if options.calibrated:
        scenario = scenario.model_copy(update={"calibration": CalibrationErrors()})
        changes.append("calibrated")
    return scenario, changes, driven, clip


def _stills(scenario: Scenario, scene: Scene, seed: int) -> dict[str, NDArray[np.uint8]]:
    """Return one image of every static camera."""
    painted = PitchTemplate.from_spec(scenario.pitch)
    people, drawn = scene.truth.joints[0], scene.cameras
    with ThreadPoolExecutor() as pool:  # the renderer's kernels release the GIL
        rendered = pool.map(
            lambda camera: render_pitch(camera, painted, people, seed, scenario.look),
            drawn.values(),
        )
        return dict(zip(drawn, rendered, strict=True))


def _key_frames(scenario: Scenario, scene: Scene, seed: int) -> dict[str, KeyFrames]:
    """Return the annotated key frames of the broadcast camera's video, if the scenario has any."""
    if scene.broadcast is None or not scenario.key_frames:
        return {}
    painted = PitchTemplate.from_spec(scenario.pitch)
    people, rng = scene.truth.joints, np.random.default_rng([seed, 4])
    clicked = click_key_frames(
        scene.broadcast, painted, people, scenario.clicks, scenario.key_frames, rng
    )
    return {CLIP_ID: clicked}


def _write_broadcast(
    folder: Path, scenario: Scenario, camera: Camera, scene: Scene, seed: int
) -> None:
    """Write the broadcast camera's video, and the bodies estimated from it."""
    file = folder / "broadcast" / f"{CLIP_ID}.mp4"
    file.parent.mkdir()
    painted = PitchTemplate.from_spec(scenario.pitch)
    images = render_broadcast(camera, painted, scene.truth.joints, seed)
    write_video(file, images, scenario.fps)
    estimates = folder / "estimates" / f"{CLIP_ID}.npz"
    write_estimates(estimates, scene.poses, camera, scenario.fps, seed)


def write_references(
    folder: Path, scenario: Scenario, scene: Scene, *, detected: bool = True
) -> None:
    """Write the ground truth of a scene: joints, cameras, clocks, pitch and detections' persons.

    Args:
        folder: reference/ of the match.
        scenario: scenario of the scene.
        scene: the ground truth.
        detected: whether the match includes the scene's detections.
    """
    write_joints(folder / "joints.npz", scene.truth)
    if detected:
        write_joints(folder / "defined_joints.npz", replace(scene.truth, joints=scene.defined))
    write_poses(folder / "poses" / f"{CLIP_ID}.npz", scene.poses, OPEN_BODY)
    for name, camera in scene.cameras.items():
        write_static_camera(folder / "cameras" / f"{name}.npz", camera.to_calibration(name))
    if scene.broadcast is not None:
        write_moving_camera(folder / "cameras" / f"{CLIP_ID}.npz", scene.broadcast)
    for name, identities in scene.identities.items() if detected else ():
        write_archive(
            folder / "identities" / f"{name}.npz",
            {
                "frame": scene.observations[name].frame,
                "person": identities.person,
                "displaced": identities.displaced.astype(np.uint8),
            },
        )
    write_calibration_toml(
        folder / "calibration.toml",
        {name: camera.to_calibration(name) for name, camera in scene.cameras.items()},
    )
    painted = PitchTemplate.from_spec(scenario.pitch).points
    pitch = scenario.pitch.model_copy(update={"points": {n: tuple(p) for n, p in painted.items()}})
    (folder / "pitch.json").write_text(pitch.model_dump_json(indent=2) + "\n", encoding="utf-8")
    _write_json(folder / "clocks.json", scene.clocks)
    clicks = {
        name: {"wrong": dict(each.wrong), "clustered": each.clustered}
        for name, each in scene.clicks.items()
    }
    _write_json(folder / "clicks.json", clicks)


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
