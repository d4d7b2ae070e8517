"""Synthetic match folders: the inputs that a user would supply, and the ground truth."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.body import OPEN_BODY
from worldpose.formats import write_archive, write_joints, write_moving_camera, write_static_camera
from worldpose.formats.pose_file import write_poses
from worldpose.geometry import Camera
from worldpose.ingest import MatchAnnotations, write_calibration_toml, write_match
from worldpose.pitch import PitchTemplate
from worldpose.simulation.annotations import click_key_frames
from worldpose.simulation.bvh import Clip
from worldpose.simulation.detector_errors import write_estimates
from worldpose.simulation.footage import Advance, film_scene
from worldpose.simulation.paths import GroundPath
from worldpose.simulation.recordings import read_clip, read_trajectories
from worldpose.simulation.renderer import render_broadcast, render_pitch
from worldpose.simulation.scene import Scene, simulate_scene
from worldpose.simulation.settings import CalibrationErrors, Scenario
from worldpose.video import write_video

CLIP_ID = "clip"
BROADCAST_ID = "broadcast"


@dataclass(frozen=True)
class MatchOptions:
    """What a simulated match changes in its scenario, and which files it has."""

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
    """Film all cameras (`worldpose.simulation.footage.film_scene`), and write no detections, so
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

    - joints.npz (`worldpose.formats.write_joints`);
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
        seed: from 0.
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
    width, height = scenario.rig.image_size
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
                clip_id=CLIP_ID,
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
        scenario: of the scene.
        scene: the ground truth.
        detected: whether the match includes the scene's detections.
    """
    write_joints(folder / "joints.npz", scene.truth)
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
