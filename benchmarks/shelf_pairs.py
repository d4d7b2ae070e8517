"""Prints who is found in single frames of the pairs of Shelf's cameras.

    python benchmarks/shelf_pairs.py DATA [--odds 10 5 3 2 1] [--every 4]

DATA holds `shelf_dev`, see `shelf.py`. Every 4th of the frames 300 to 420 is a clip of one frame
for each of the ten pairs of cameras. The people of all cameras, tracked over all frames, are the
truth: asked are those whom both cameras of a pair detect. A person is found if a result is within
0.5 m, by the mean over the joints; results without a person are false. `--odds` are values of
`tracking.pair_odds`.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from shelf import FPS, write_case

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import read_match
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.chunking import reconstruct_joints
from worldpose.triangulation.settings import TriangulationSettings

FRAMES = range(300, 421)
FOUND_M = 0.5


def find_people(
    cameras: Camera, detections: KeypointDetections, settings: TrackingSettings
) -> tuple[Floats, Floats]:
    """Return joints (frames, persons, 17, 3) [m], and detection indices (frames, cameras, ...)."""
    tracks = track_people(cameras, detections, FPS, settings)
    index = tracks.detection_index
    if not len(tracks.person):
        return np.empty((len(index), 0, 17, 3)), np.asarray(index, dtype=np.float64)
    assigned = detections.assign_people(index)
    placed = reconstruct_joints(cameras, assigned, FPS, TriangulationSettings())
    joints = placed.triangulation.joints.astype(np.float64)
    return joints, np.asarray(index, dtype=np.float64)


def pair_people(truth: Floats, found: Floats) -> tuple[Floats, Floats, Floats]:
    """Return rows and columns of people and results of one frame, and their distances [m]."""
    off = np.linalg.norm(truth[:, None] - found[None], axis=-1)
    known = np.isfinite(off)
    mean = np.where(known, off, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
    mean = np.where(known.any(axis=-1), mean, np.inf)
    rows, columns = linear_sum_assignment(np.minimum(mean, 1e3))
    near = mean[rows, columns] <= FOUND_M
    return rows[near], columns[near], mean[rows[near], columns[near]]


def main() -> None:
    """Print one line per value of `pair_odds`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--odds", type=float, nargs="+", default=[10.0, 5.0, 3.0, 2.0, 1.0])
    parser.add_argument("--every", type=int, default=4)
    options = parser.parse_args()
    given = options.data / "shelf_dev" / "import"
    names = tuple(sorted(file.stem for file in (given / "detections").glob("*.json")))
    with tempfile.TemporaryDirectory() as temporary:
        match = read_match(write_case(given, names, FRAMES, Path(temporary)))
        ids = [camera.id for camera in match.spec.static_cameras]
        cameras = Camera.stack([Camera.from_calibration(match.calibrations[name]) for name in ids])
        seen = KeypointDetections.stack([read_unit(match, name)[0] for name in ids])
    truth, index = find_people(cameras, seen, TrackingSettings())
    for odds in options.odds:
        settings = TrackingSettings(pair_odds=odds)
        asked = found = false = 0
        errors: list[float] = []
        for pair in itertools.combinations(range(len(ids)), 2):
            views = np.array(pair)
            for frame in range(0, len(truth), options.every):
                both = (index[frame, views] >= 0).all(axis=0)
                now = seen[frame : frame + 1]
                one = KeypointDetections.from_keypoints(
                    now.keypoints[:, views], now.confidence[:, views]
                )
                joints, _ = find_people(cameras[views], one, settings)
                rows, _, distance = pair_people(truth[frame], joints[0])
                asked += int(both.sum())
                found += int(both[rows].sum())
                false += joints.shape[1] - len(rows)
                errors += distance.tolist()
        print(
            f"odds {odds:g}: found {found} of {asked} = {100.0 * found / asked:.1f} %, mean error "
            f"{100.0 * np.mean(errors):.1f} cm, {false} false",
            flush=True,
        )


if __name__ == "__main__":
    main()
