"""Synthetic match folders: what a user would bring in, with the truth beside it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.cameras import Camera
from worldpose.ingest import write_match
from worldpose.release import write_archive, write_joints, write_static_camera
from worldpose.synthetic.scene import Scene, simulate_scene
from worldpose.synthetic.settings import Scenario
from worldpose.synthetic.trajectories import read_trajectories

CLIP_ID = "clip"
BROADCAST_ID = "broadcast"


def simulate_match(
    scenario: Scenario,
    seed: int,
    out: Path,
    *,
    duration: float | None = None,
    cameras: int | None = None,
    players: int | None = None,
    trajectories: Path | None = None,
) -> MatchSpec:
    """Write a synthetic match folder with its truth; the same arguments give the same bytes.

    Besides what every match folder has (match.yaml, pitch.json, calibration.toml, detections/) it
    holds, under reference/: joints.npz (`worldpose.release.write_joints`); cameras/<camera>.npz
    (`worldpose.release.write_static_camera`) and, the same with a row a frame, cameras/clip.npz of
    the broadcast camera; identities/<camera or clip>.npz: `frame` (frames,) int64, `person`
    (frames, detections) int16, the index into the joints file's `person_ids` of every detection,
    -1 for false people and padding, and `displaced` (frames, detections, 17) uint8, keypoints put
    far off; clocks.json: frames that each static camera lies behind its stated clock.

    Args:
        scenario: what happens.
        seed: from 0.
        out: absent or an empty folder; written whole or not at all.
        duration: [s], instead of the scenario's.
        cameras: number of static cameras, instead of the scenario's.
        players: number of people, instead of the scenario's.
        trajectories: tracking data (`read_trajectories`) that drives the people instead; the clip
            ends with it.

    Returns:
        The match's match.yaml. Its id names scenario, seed and what differs from the scenario.

    Raises:
        InputError: `out` holds files, or the trajectories cannot be used.
    """
    changes = []
    if duration is not None:
        scenario = scenario.model_copy(update={"duration": duration})
        changes.append(f"{duration:g}s")
    if cameras is not None:
        rig = scenario.rig.model_copy(update={"cameras": cameras})
        scenario = scenario.model_copy(update={"rig": rig})
        changes.append(f"{cameras}cameras")
    if players is not None:
        crowd = scenario.crowd.model_copy(update={"people": players})
        scenario = scenario.model_copy(update={"crowd": crowd})
        changes.append(f"{players}players")
    driven = None
    if trajectories is not None:
        driven, length = read_trajectories(trajectories, scenario.duration, most=players)
        scenario = scenario.model_copy(update={"duration": length})
        changes.append(f"tracks{hashlib.sha256(trajectories.read_bytes()).hexdigest()[:8]}")
    scene = simulate_scene(scenario, seed, clip_id=CLIP_ID, driven=driven)
    calibrations = {name: camera.to_calibration(name) for name, camera in scene.given.items()}
    width, height = scenario.rig.image_size
    specs = [CameraSpec(id=name, width=width, height=height) for name in scene.cameras]
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
    write_match(
        out,
        spec,
        calibrations=calibrations,
        observations=scene.observations,
        pitch=scenario.pitch,
        references=lambda folder: write_references(folder / "reference", scene),
    )
    return spec


def write_references(folder: Path, scene: Scene) -> None:
    """Write the truth of a scene: joints, cameras, clocks and who every detection is."""
    write_joints(folder / "joints.npz", scene.truth)
    for name, camera in scene.cameras.items():
        write_static_camera(folder / "cameras" / f"{name}.npz", camera.to_calibration(name))
    if scene.broadcast is not None:
        _write_moving_camera(folder / "cameras" / f"{CLIP_ID}.npz", scene.broadcast)
    for name, identities in scene.identities.items():
        write_archive(
            folder / "identities" / f"{name}.npz",
            {
                "frame": scene.observations[name].frame,
                "person": identities.person,
                "displaced": identities.displaced.astype(np.uint8),
            },
        )
    clocks = json.dumps(scene.clocks, indent=2)
    (folder / "clocks.json").write_text(clocks + "\n", encoding="utf-8")


def _write_moving_camera(path: Path, camera: Camera) -> None:
    """Write K (T,3,3), k (T,5), R (T,3,3) and t (T,3), as the WorldPose release has them."""
    intrinsics = np.zeros((len(camera.focal), 3, 3))
    intrinsics[:, (0, 1), (0, 1)] = camera.focal
    intrinsics[:, :2, 2] = camera.principal_point
    intrinsics[:, 2, 2] = 1.0
    pose = camera.cam_from_world
    write_archive(
        path,
        {"K": intrinsics, "k": camera.distortion, "R": pose.rotation, "t": pose.translation},
    )
