"""Synthetic match folders: what a user would bring in, with the truth beside it."""

from __future__ import annotations

from pathlib import Path

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.ingest import write_match
from worldpose.release import write_archive, write_joints, write_static_camera
from worldpose.synthetic.scenarios import Scenario
from worldpose.synthetic.scene import Scene, simulate_scene

CLIP_ID = "clip"


def simulate_match(
    scenario: Scenario,
    seed: int,
    out: Path,
    *,
    duration: float | None = None,
    cameras: int | None = None,
    players: int | None = None,
) -> MatchSpec:
    """Write a synthetic match folder with its truth; the same arguments give the same bytes.

    Besides what every match folder has (match.yaml, pitch.json, calibration.toml, detections/) it
    holds reference/joints.npz (`worldpose.release.write_joints`), reference/cameras/<camera>.npz
    (`worldpose.release.write_static_camera`) and reference/identities/<camera>.npz: `frame`
    (frames,) int64 and `person` (frames, detections) int16, the index into the joints file's
    `person_ids` of every detection, -1 for false people and padding.

    Args:
        scenario: what happens.
        seed: from 0.
        out: absent or an empty folder; written whole or not at all.
        duration: [s], instead of the scenario's.
        cameras: number of static cameras, instead of the scenario's.
        players: number of people, instead of the scenario's.

    Returns:
        The match's match.yaml. Its id names scenario, seed and what differs from the scenario.

    Raises:
        InputError: `out` holds files.
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
    scene = simulate_scene(scenario, seed)
    calibrations = {name: camera.to_calibration(name) for name, camera in scene.cameras.items()}
    width, height = scenario.rig.image_size
    spec = MatchSpec(
        match_id="-".join([scenario.name, str(seed), *changes]),
        fps=scenario.fps,
        cameras=tuple(CameraSpec(id=name, width=width, height=height) for name in scene.cameras),
        clips=(ClipSpec(id=CLIP_ID, frame_count=len(scene.truth.frames)),),
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
    """Write the truth of a scene: joints, cameras and who every detection is."""
    write_joints(folder / "joints.npz", scene.truth)
    for name, camera in scene.cameras.items():
        write_static_camera(folder / "cameras" / f"{name}.npz", camera.to_calibration(name))
        write_archive(
            folder / "identities" / f"{name}.npz",
            {"frame": scene.observations[name].frame, "person": scene.identities[name]},
        )
