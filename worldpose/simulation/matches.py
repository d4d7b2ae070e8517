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

from data_contracts.arrays import Floats, Image
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
from worldpose.simulation.renderer import Moment, RenderedFrame, film_broadcast, open_view
from worldpose.simulation.scene import Scene, broadcast_id, simulate_scene
from worldpose.simulation.settings import CalibrationErrors, MatchOptions, Scenario
from worldpose.simulation.venues import build_venue
from worldpose.video.files import write_video

Advance = Callable[[str, int, int], None]


def simulate_match(
    scenario: Scenario,
    seed: int,
    out: Path,
    options: MatchOptions = MatchOptions(),  # noqa: B008
    *,
    advance: Advance | None = None,
) -> MatchSpec:
    """Write a synthetic match folder with its ground truth, and return its match.yaml.

    The same arguments give the same bytes; docs/explanation/simulation.md describes the files. The
    write is atomic; InputError if `out` holds files, or the trajectories or the capture cannot be
    used.
    """
    scenario, driven, clip = _apply_options(scenario, options)
    scene = simulate_scene(scenario, seed, driven=driven, clip=clip)
    stage = _Stage(scene, scenario, seed, options, advance)
    has_errors = scenario.calibration != CalibrationErrors()
    given = scene.given if options.calibrated or has_errors else {}
    spec = stage.describe(options.name(scenario.name, seed, *_replayed(options)))
    write_match(
        out,
        spec,
        calibrations={name: camera.to_calibration(name) for name, camera in given.items()},
        observations={} if options.render else scene.observations,
        pitch=scene.surveyed,
        annotations=MatchAnnotations(
            clicked={name: clicks.markings for name, clicks in scene.clicks.items()},
            key_frames=stage.key_frames(),
        ),
        stills=stage.draw_stills() if options.stills and not options.render else {},
        further=stage.write_further,
    )
    return spec


def _replayed(options: MatchOptions) -> list[str]:
    """Return names of the recordings that people replay."""
    files = {"tracks": options.trajectories, "mocap": options.mocap}
    return [
        f"{kind}{hashlib.sha256(file.read_bytes()).hexdigest()[:8]}"
        for kind, file in files.items()
        if file is not None
    ]


def _apply_options(
    scenario: Scenario, options: MatchOptions
) -> tuple[Scenario, list[GroundPath] | None, Clip | None]:
    """Return the changed scenario, tracked paths, and motion capture."""
    updates, driven = dict[str, object](), None
    duration = scenario.duration if options.duration is None else options.duration
    if options.cameras is not None:
        updates["rig"] = scenario.rig.model_copy(update={"cameras": options.cameras})
    if options.players is not None:
        updates["crowd"] = scenario.crowd.model_copy(update={"people": options.players})
    if options.trajectories is not None:
        driven, duration = read_trajectories(options.trajectories, duration, options.players)
    if options.calibrated:
        updates["calibration"] = CalibrationErrors()
    clip = None if options.mocap is None else read_clip(options.mocap)
    return scenario.model_copy(update={**updates, "duration": duration}), driven, clip


@dataclass
class _Stage:
    """A dressed scene ready for filming, and the files of a match of it."""

    scene: Scene
    scenario: Scenario
    seed: int
    options: MatchOptions
    advance: Advance | None

    @functools.cached_property
    def pitch(self) -> PitchTemplate:
        """Return the pitch as painted."""
        return PitchTemplate.from_spec(self.scenario.pitch)

    @functools.cached_property
    def times(self) -> Floats:
        """Return the times of the frames and of one more [s], when the last shutter is open."""
        return np.arange(len(self.scene.truth.frames) + 1) / self.scenario.fps

    @functools.cached_property
    def poses(self) -> BodyParameters:
        """Return the bodies (persons, times)."""
        return self.scene.crowd.poses(self.times)

    @functools.cached_property
    def cast(self) -> Cast:
        """Return the people in their clothes."""
        crowd = self.scene.crowd
        roles = assign_roles(self.scenario.crowd, len(crowd.paths))
        betas = np.array([body.betas for body in crowd.bodies]).reshape(-1, 10)
        return dress_people(betas, roles, self.seed, self.scenario.look.patterns)

    def fps(self, name: str) -> float:
        """Return the frame rate of a camera [1/s]."""
        view = self.scene.broadcast.get(name)
        return self.scenario.fps if view is None else view.fps

    def count(self, name: str) -> int:
        """Return the number of images of a camera."""
        view = self.scene.broadcast.get(name)
        return len(self.scene.truth.frames) if view is None else len(view.times)

    def film(self, name: str, frames: int | None = None) -> Iterator[RenderedFrame]:
        """Yield the first frames of a static camera or a broadcast view, by default all."""
        fps, look = self.fps(name), self.scenario.look
        count = self.count(name) if frames is None else frames
        late = self.scene.clocks.get(name, 0.0) / fps
        moments = self._moments(np.arange(count + 1) / fps + late, fps)
        if name in self.scene.broadcast:
            venue = build_venue(self.pitch, self.seed, look)
            yield from film_broadcast(self.scene.broadcast[name].camera, venue, moments)
            return
        view = open_view(self.scene.cameras[name], self.pitch, self.seed, look)
        for frame, moment in enumerate(moments):
            yield view.expose(moment, frame)

    def _moments(self, times: Floats, fps: float) -> Iterator[Moment]:
        """Yield the people in every frame of a camera, from its times and that of one more [s]."""
        is_usual = np.array_equal(times, self.times[: len(times)])
        poses = self.poses if is_usual else self.scene.crowd.poses(times)
        share = self.scenario.look.exposure_s * fps
        surfaces = (self.cast.pose(poses[:, k]) for k in range(len(times)))
        for opened, following in pairwise(surfaces):
            closed = opened.toward(following, share) if share > 0.0 else opened
            yield Moment(self.cast, opened, closed)

    def draw_stills(self) -> dict[str, Image]:
        """Return the first image of every static camera."""
        names = list(self.scene.cameras)
        with ThreadPoolExecutor() as pool:  # the renderer's kernels release the GIL
            drawn = pool.map(lambda name: next(self.film(name, 1)).image, names)
            return dict(zip(names, drawn, strict=True))

    def describe(self, match_id: str) -> MatchSpec:
        """Return match.yaml."""
        scene, scenario, specs = self.scene, self.scenario, list[CameraSpec]()
        width, height = scenario.rig.image_size_px
        for name in scene.cameras:
            still = f"stills/{name}.png" if self.options.stills else None
            specs.append(CameraSpec(id=name, width=width, height=height, still=still))
        names = tuple(broadcast_id(number) for number in range(len(scene.broadcast)))
        for name, view in zip(names, scene.broadcast.values(), strict=True):
            wide, high = view.camera.image_size.reshape(-1, 2)[0].tolist()
            fps = None if view.fps == scenario.fps else view.fps
            specs.append(CameraSpec(id=name, kind="broadcast", width=wide, height=high, fps=fps))
        broadcast = names if len(names) > 1 else next(iter(names), None)
        frames = len(scene.truth.frames)
        return MatchSpec(
            match_id=match_id,
            fps=scenario.fps,
            cameras=tuple(specs),
            clips=(ClipSpec(id=CLIP_ID, frame_count=frames, broadcast=broadcast),),
        )

    def key_frames(self) -> dict[str, KeyFrames]:
        """Return the annotated key frames of the broadcast cameras' videos, if there are any."""
        scenario, scene = self.scenario, self.scene
        if not (scenario.key_frames and (self.options.video or self.options.render)):
            return {}
        rng, clicked = np.random.default_rng([self.seed, 4]), {}
        for name, view in scene.broadcast.items():
            is_usual = view.fps == scenario.fps
            people = scene.truth.joints if is_usual else scene.crowd.joints(view.times)
            clicked[name] = click_key_frames(
                view.camera, self.pitch, people, scenario.clicks, scenario.key_frames, rng
            )
        return clicked

    def write_further(self, folder: Path) -> None:
        """Write ground truth, videos, and bodies of a monocular method."""
        scene, scenario, options = self.scene, self.scenario, self.options
        self._write_truth(folder / "reference")
        if options.render:
            # Each camera holds its empty stadium and encoder frames.
            with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
                names = (*scene.cameras, *scene.broadcast)
                list(pool.map(lambda name: self._write_film(name, folder), names))
            return
        is_filmed = scenario.key_frames and options.video
        for number, (name, view) in enumerate(scene.broadcast.items() if is_filmed else ()):
            video = folder / "broadcast" / f"{name}.mp4"
            video.parent.mkdir(exist_ok=True)
            write_video(video, (frame.image for frame in self.film(name)), view.fps)
            poses = scene.poses if view.fps == scenario.fps else scene.crowd.poses(view.times)
            given = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
            bodies = BodyParameters(*(np.swapaxes(values, 0, 1) for values in given))
            rng = np.random.default_rng([self.seed, 5, number][: 3 if number else 2])
            found = estimate_bodies(
                load_open_body(), bodies, view.camera, view.fps, MonocularErrors(), rng
            )
            write_archive(folder / "estimates" / f"{name}.npz", found)

    def _write_film(self, name: str, folder: Path) -> None:
        """Write a camera's video, still, masks and boxes."""
        is_static = name in self.scene.cameras
        file = folder / ("videos" if is_static else "broadcast") / f"{name}.mp4"
        masks = folder / "reference" / "masks" / name
        file.parent.mkdir(exist_ok=True)
        if self.options.masks:
            masks.mkdir(parents=True)
        boxes, visible = [], []

        def images() -> Iterator[Image]:
            for number, frame in enumerate(self.film(name)):
                boxes.append(frame.boxes.astype(np.float32))
                visible.append(frame.visible.astype(np.float32))
                if self.options.stills and is_static and number == 0:
                    write_still(folder / "stills" / f"{name}.png", frame.image)
                if self.options.masks:
                    mask = (frame.person_ids + 1).astype(np.uint8)
                    cv2.imwrite(str(masks / f"{number:06d}.png"), mask)
                yield frame.image
                if self.advance is not None:
                    self.advance(name, number + 1, self.count(name))

        write_video(file, images(), self.fps(name))
        arrays = {"boxes": np.array(boxes), "visible": np.array(visible)}
        write_archive(folder / "reference" / "boxes" / f"{name}.npz", arrays)

    def _write_truth(self, folder: Path) -> None:
        """Write the ground truth, with its detections' persons if there are detections."""
        scene, is_detected = self.scene, not self.options.render
        points = {name: tuple(place) for name, place in self.pitch.points.items()}
        clicks = {
            name: {"wrong": dict(each.wrong), "clustered": each.clustered}
            for name, each in scene.clicks.items()
        }
        write_reference(
            folder,
            scene.truth,
            scene.defined if is_detected else None,
            scene.cameras,
            scene.identities if is_detected else {},
            {"clocks": scene.clocks, "clicks": clicks},
            self.scenario.pitch.model_copy(update={"points": points}),
        )
        write_poses(folder / "poses" / f"{CLIP_ID}.npz", scene.poses, OPEN_BODY)
        for name, view in scene.broadcast.items():
            write_moving_camera(folder / "cameras" / f"{name}.npz", view.camera[view.number])
