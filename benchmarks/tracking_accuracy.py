"""Prints the tracking accuracy in simulated clips, cameras as surveyed.

    python benchmarks/tracking_accuracy.py [match:501:60 corner-kick:501 crossing:501 ...]
    python benchmarks/tracking_accuracy.py --trajectories DATA

A clip is scenario:seed, or scenario:seed:seconds. With `--trajectories` people run along the
recorded paths in that folder's files, at most twelve seconds of each. Coverage is over people's
frames with two cameras or more; speed is processor time of tracking alone.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.simulation.recordings import read_trajectories
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import Scene, simulate_scene
from worldpose.simulation.settings import Scenario
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

CLIPS = ["match:501:60", "corner-kick:501", "corner-kick:502", "crossing:501", "crossing:502"]
LONGEST, MOST = 12.0, 25


def tell(name: str, scene: Scene, fps: float) -> None:
    """Print a clip's metrics."""
    seen = scene.static_views()
    cameras = Camera.stack(list(scene.given.values()))
    begin = time.process_time()
    tracks = track_people(cameras, seen.detections, fps, TrackingSettings())
    spent = time.process_time() - begin
    found = JointTracks(scene.truth.frames, np.asarray(tracks.person), tracks.joints.astype(float))
    scores, _ = evaluate_joints(found, scene.truth, fps=fps)
    frames, persons = scene.truth.joints.shape[:2]
    print(
        f"{name}: {frames} frames, {persons} people: IDF1 {scores.idf1:.4f}, "
        f"{scores.switches} switches, coverage {scores.coverage:.4f}, "
        f"{tracks.report.undecided} joins undecided, {frames / spent:.0f} frames/s",
        flush=True,
    )


def read_recording(file: Path) -> tuple[Scenario, Scene]:
    """Return `match` with people on recorded paths."""
    paths, length = read_trajectories(file, LONGEST, max_people=MOST)
    base = SCENARIOS["match"]
    crowd = base.crowd.model_copy(update={"people": len(paths), "officials": 0})
    changes = {"duration": min(length, LONGEST), "crowd": crowd, "broadcast": None}
    scenario = base.model_copy(update=changes)
    return scenario, simulate_scene(scenario, 1, driven=paths)


def main() -> None:
    """Print one line per clip."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", nargs="*", default=CLIPS)
    parser.add_argument("--trajectories", type=Path, help="folder of recorded ways, *.npz")
    options = parser.parse_args()
    if options.trajectories is not None:
        for file in sorted(options.trajectories.glob("*.npz")):
            scenario, scene = read_recording(file)
            tell(file.stem, scene, scenario.fps)
        return
    for clip in options.clips:
        name, seed, *seconds = clip.split(":")
        changes = {"broadcast": None, **({"duration": float(seconds[0])} if seconds else {})}
        scenario = SCENARIOS[name].model_copy(update=changes)
        tell(clip, simulate_scene(scenario, int(seed)), scenario.fps)


if __name__ == "__main__":
    main()
