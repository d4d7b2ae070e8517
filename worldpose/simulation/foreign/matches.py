"""Match folders of the second simulator, with their ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from worldpose.formats import JointTracks, write_archive, write_joints, write_static_camera
from worldpose.ingest import MatchAnnotations, write_calibration_toml, write_match
from worldpose.simulation.foreign.recordings import read_recordings
from worldpose.simulation.foreign.scenarios import ForeignScenario
from worldpose.simulation.foreign.scenes import ForeignScene, simulate_foreign_scene

CLIP_ID: Final = "clip"


def simulate_foreign_match(
    scenario: ForeignScenario,
    seed: int,
    out: Path,
    *,
    duration: float | None = None,
    cameras: int | None = None,
    people: int | None = None,
    recordings: Path | None = None,
    calibrated: bool = False,
) -> MatchSpec:
    """Write a match folder of the second simulator; the same arguments give the same bytes.

    Under reference/ are joints.npz, cameras/<camera>.npz, calibration.toml, identities/,
    pitch.json, clocks.json and clicks.json as in other simulated matches, and

    - defined_joints.npz: joints as the detector defines them, as a joints file;
    - world.json: motion and bones of every person, detector, lenses and mountings.

    Args:
        scenario: ranges.
        seed: from 0.
        out: absent or an empty folder; the write is atomic.
        duration: [s], instead of the scenario's.
        cameras: number of them, instead of the scenario's.
        people: number of them, instead of the scenario's.
        recordings: folder with npz files of motion capture and tracking data (`read_recordings`).
        calibrated: write the exact cameras.

    Returns:
        The match's match.yaml.

    Raises:
        InputError: `out` holds files, or the recordings cannot be used.
    """
    replayed = None if recordings is None else read_recordings(recordings)
    scene = simulate_foreign_scene(
        scenario,
        seed,
        duration=duration,
        cameras=cameras,
        people=people,
        recordings=replayed,
        calibrated=calibrated,
    )
    changes = {
        f"{duration:g}s" if duration else "": duration,
        f"{cameras}cameras": cameras,
        f"{people}players": people,
        "recordings": recordings,
        "calibrated": calibrated,
    }
    parts = [scenario.name, str(seed), *(text for text, made in changes.items() if made)]
    spec = MatchSpec(
        match_id="-".join(parts),
        fps=scene.fps,
        cameras=tuple(
            CameraSpec(
                id=name,
                width=int(camera.camera.image_size[0]),
                height=int(camera.camera.image_size[1]),
                offset_frames=scene.offsets[name],
            )
            for name, camera in scene.cameras.items()
        ),
        clips=(ClipSpec(id=CLIP_ID, frame_count=len(scene.truth.frames)),),
        pitch="none" if scene.pitch is None else None,
    )
    write_match(
        out,
        spec,
        calibrations=scene.given,
        observations={
            name: _number_frames(report.observations, scene.offsets[name])
            for name, report in scene.reports.items()
        },
        pitch=None if scene.pitch is None else scene.pitch.stated,
        annotations=MatchAnnotations(clicked=scene.clicked),
        further=lambda folder: _write_reference(folder / "reference", scene),
    )
    return spec


def _number_frames(observations: KeypointDetections, offset: int) -> KeypointDetections:
    """Return the observations with the camera's own frame numbers."""
    return KeypointDetections(frame=observations.frame + offset, **observations.arrays())


def _write_reference(folder: Path, scene: ForeignScene) -> None:
    write_joints(folder / "joints.npz", scene.truth)
    truth = scene.truth
    defined = JointTracks(truth.frames, truth.person_ids, scene.defined, views=truth.views)
    write_joints(folder / "defined_joints.npz", defined)
    records = {name: each.camera.to_calibration(name) for name, each in scene.cameras.items()}
    for name, record in records.items():
        write_static_camera(folder / "cameras" / f"{name}.npz", record)
    write_calibration_toml(folder / "calibration.toml", records)
    for name, report in scene.reports.items():
        write_archive(
            folder / "identities" / f"{name}.npz",
            {
                "frame": report.observations.frame + scene.offsets[name],
                "person": report.person,
                "displaced": report.displaced.astype(np.uint8),
            },
        )
    if scene.pitch is not None:
        _write_json(folder / "pitch.json", scene.pitch.painted.model_dump(mode="json"))
        wrong = {name: {"wrong": each} for name, each in scene.misnamed.items()}
        _write_json(folder / "clicks.json", wrong)
    _write_json(folder / "clocks.json", scene.late)
    _write_json(folder / "world.json", scene.record)


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
