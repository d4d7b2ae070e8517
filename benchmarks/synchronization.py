"""Prints errors of clock offsets that are found without a hint.

    python benchmarks/synchronization.py shelf DATA/shelf_dev
    python benchmarks/synchronization.py run PROJECT MATCH          # any match with 2D poses
    python benchmarks/synchronization.py simulated 100              # first seed

Cameras are shifted by -12, -3.5, 0, 2.25 and 20 frames in five orders. Real detections are tracked
and interpolated between frames; their own offsets, estimated before the shift, count as true. In a
run whose people cannot be triangulated, shifts are whole frames. Simulated are 40 clips of 4 s in
five scenarios, at four times the frame rate, so that fractions are exact, before five cameras whose
orientation has an error of 1 mrad per axis.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import worldpose
from data_contracts.keypoints import KeypointDetections
from flows.cli.synchronize import load_clip
from flows.registering import open_match
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.store.store import Store
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.clocks import shift_in_time
from worldpose.triangulation.synchronization import Synchronization, shift_frames, synchronize

SHIFTS = np.array([-12.0, -3.5, 0.0, 2.25, 20.0])
WANTED = 0.2
"""Largest error that counts as found [frame]."""
CASES = {"tiny": 16, "crossing": 8, "penalty-box": 8, "match": 4, "hard": 4}
FINE = 4
TILT = 1e-3


def orders(cameras: int) -> Iterator[NDArray[np.float64]]:
    """Yield the shifts (cameras,) of five orders [frame]."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        yield np.resize(SHIFTS, max(cameras, 5))[rng.permutation(max(cameras, 5))][:cameras]


def shift(
    cameras: Camera, seen: KeypointDetections, fps: float, late: NDArray[np.float64]
) -> tuple[KeypointDetections, NDArray[np.float64]]:
    """Return detections whose frame t shows the time t + late, and these offsets."""
    people = track_people(cameras, seen, fps).detection_index
    every = np.arange(len(late))
    if not people.shape[2]:
        whole = np.rint(late)
        return shift_frames(seen, every, -whole.astype(np.int64)), whole
    return shift_in_time(seen.assign_people(people), -late), late


def report(name: str, found: Synchronization, true: NDArray[np.float64]) -> bool:
    """Print one line; return whether all offsets are found within `WANTED`."""
    off = found.late - true
    off = off - np.nanmedian(off) if np.isfinite(off).any() else off
    unknown = int(np.isnan(off).sum())
    worst = float(np.nanmax(np.abs(off))) if unknown < len(off) else np.nan
    print(
        f"{name:34s} worst {worst:5.2f} frames, not told {unknown} of {len(off)}, standard "
        f"deviations {np.round(found.std, 2).tolist()}",
        flush=True,
    )
    return unknown == 0 and worst <= WANTED


def shift_real_detections(
    cameras: Camera, seen: KeypointDetections, fps: float, pitch: PitchTemplate | None
) -> Iterator[bool]:
    """Yield whether each case of shifted real detections is found."""
    own = synchronize(cameras, seen, fps, pitch=pitch)
    print(f"as they are: {np.round(own.late, 2).tolist()}, {np.round(own.std, 2).tolist()}")
    for late in orders(int(cameras.batch_shape[0])):
        moved, true = shift(cameras, seen, fps, late)
        found = synchronize(cameras, moved, fps, pitch=pitch)
        yield report(str(true.tolist()), found, true + own.late)


def simulate_cases(first: int) -> Iterator[bool]:
    """Yield whether each simulated case is found."""
    for name, count in CASES.items():
        for seed in range(first, first + count):
            scenario = SCENARIOS[name]
            fps, before, frames = scenario.fps, 20, round(4.0 * scenario.fps)
            rig = scenario.rig.model_copy(update={"cameras": 5, "clock_std_frames": 0.0})
            seconds = (frames + before + 25) / fps
            changes = {"fps": FINE * fps, "duration": seconds, "rig": rig, "broadcast": None}
            scene = simulate_scene(scenario.model_copy(update=changes), seed)
            rng = np.random.default_rng(seed)
            late = SHIFTS[rng.permutation(5)]
            rows = np.rint(FINE * (np.arange(frames)[:, None] + before + late)).astype(int)
            given = scene.static_views().detections
            arrays = {n: array[rows, np.arange(5)] for n, array in given.arrays().items()}
            cameras = []
            for camera in scene.cameras.values():
                error = Rigid.from_rotvec(rng.normal(0.0, TILT, 3), np.zeros(3))
                cameras.append(replace(camera, cam_from_world=error @ camera.cam_from_world))
            found = synchronize(
                Camera.stack(cameras),
                KeypointDetections(frame=np.arange(frames), **arrays),
                fps,
                pitch=PitchTemplate.from_spec(scenario.pitch),
            )
            yield report(f"{name} {seed} {late.tolist()}", found, late)


def main() -> None:
    """Print a line per case, and how many are found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("shelf", "run", "simulated"))
    parser.add_argument("arguments", nargs="+")
    asked = parser.parse_args()
    if asked.what == "simulated":
        cases = simulate_cases(int(asked.arguments[0]))
    elif asked.what == "shelf":
        given = Path(asked.arguments[0]) / "import"
        known = worldpose.read_cameras(given / "calibration.toml")
        files = [given / "detections" / f"{name}.json" for name in known]
        seen = KeypointDetections.stack([worldpose.read_observations(file) for file in files])
        cases = shift_real_detections(Camera.stack(list(known.values())), seen, 25.0, None)
    else:
        store = Store.open(asked.arguments[0])
        match = open_match(store, asked.arguments[1])
        run = worldpose.open_run(asked.arguments[0], match.match_id)
        cameras, _, seen = load_clip(run, match, match.folder.spec.clips[0].id)
        pitch = match.folder.pitch
        place = None if pitch is None else PitchTemplate.from_spec(pitch)
        cases = shift_real_detections(cameras, seen, match.folder.spec.fps, place)
    found = list(cases)
    print(f"{sum(found)} of {len(found)} cases: all offsets within {WANTED} frames")


if __name__ == "__main__":
    main()
