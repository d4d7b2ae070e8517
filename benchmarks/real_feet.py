"""Compares bodies with and without feet in cameras that were left out, on real 2D poses with feet.

    python benchmarks/real_feet.py TRIAL

TRIAL is the folder of a Pose2Sim trial of one person whose `pose/` has feet. There is no truth. One
camera after the other is left out; the others triangulate the person, and bodies are fitted with
and without the points of the feet. The table shows median distances of the left-out camera's
keypoints from the reprojections, in pixels and at the person's depth, and of the same points of
bodies fitted without feet, which stand as motion and the rest of the body suggest. Bodies are taken
where the detector sees them: offsets of joints and points are added, those of feet without feet
being zero. The last lines are the spread of lengths over time, for points triangulated by all
cameras.

2D poses of Pose2Sim's demo come from `infra/real_demo/blaze_poses.py`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose import read_cameras
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body_fitting.body_fit import BodyFit, ClipEvidence, fit_bodies
from worldpose.body_fitting.extra_points import perceived_points
from worldpose.body_fitting.objective import perceived_joints
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.formats.detection_files import read_openpose_folder
from worldpose.geometry.cameras import Camera
from worldpose.ingest.importing import import_pose2sim
from worldpose.triangulation.chunking import reconstruct_joints
from worldpose.triangulation.passes import Triangulation
from worldpose.triangulation.settings import TriangulationSettings

GROUPS = {
    "knees": (13, 14),
    "ankles": (15, 16),
    "big toes": (17, 20),
    "small toes": (18, 21),
    "heels": (19, 22),
}
MODEL = load_open_body()
FPS = 60.0
"""Frame rate of Pose2Sim's demo [1/s]."""


def open_trial(trial: Path) -> tuple[Camera, KeypointDetections, float]:
    """Return cameras, detections (frames, cameras, detections) and frame rate."""
    with tempfile.TemporaryDirectory() as temporary:
        match = Path(temporary) / "match"
        spec, notes = import_pose2sim(trial, match, fps=FPS)
        print("\n".join(notes))
        given = read_cameras(match / "calibration.toml")
    folders = [trial / "pose" / f"{name}_json" for name in given]
    people = [read_openpose_folder(folder).people for folder in folders]
    seen = KeypointDetections.stack(people)
    index = np.where(np.isfinite(seen.score).any(axis=2), 0, -1)
    return (
        Camera.stack(list(given.values())),
        seen.assign_people(index[..., None].astype(np.int16)),
        spec.fps,
    )


def fit(placed: Triangulation, fps: float) -> BodyFit:
    """Return the bodies of triangulated joints."""
    evidence = ClipEvidence(
        placed.joints,
        placed.covariance,
        fps,
        common_bias=placed.common_bias,
        shared_covariance=placed.shared_covariance,
        extra=placed.extra,
    )
    return fit_bodies(MODEL, evidence, BodyFittingSettings())


def perceived_body(bodies: BodyFit) -> Floats:
    """Return joints and feet (frames, 23, 3) [m] of the only person, as the detector sees them."""
    joints = perceived_joints(bodies.joints, bodies.offsets)
    points = fold_keypoints(MODEL, FEET)(bodies.parameters)
    if bodies.extra is not None:
        own = bodies.extra.points
        places = [FEET.index(point) for point in own]
        offsets = bodies.extra.offsets
        points[:, :, places] += perceived_points(MODEL, own, bodies.parameters, offsets)
    return np.concatenate([joints, points], axis=2)[:, 0]


def distances(camera: Camera, points: Floats, seen: KeypointDetections, c: int) -> Floats:
    """Return distances (frames, 23, 2) of a camera's keypoints [px] and at their depth [m]."""
    assert seen.extra_keypoints is not None
    pixels = np.concatenate([seen.keypoints[:, c, 0], seen.extra_keypoints[:, c, 0]], axis=1)
    shown = camera.project(points.reshape(-1, 3)).reshape(pixels.shape)
    away = np.linalg.norm(shown - pixels, axis=-1)
    depth = camera.cam_from_world.apply(points)[..., 2]
    return np.stack([away, away * depth / camera.focal.mean()], axis=-1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial", type=Path, help="folder of a Pose2Sim trial with feet in pose/")
    cameras, seen, fps = open_trial(parser.parse_args().trial)
    settings = TriangulationSettings()
    names = ("triangulated", "bodies without feet", "bodies with feet")
    found: dict[str, list[Floats]] = {name: [] for name in names}
    for c in range(seen.detection_index.shape[1]):
        index = seen.detection_index.copy()
        index[:, c] = -1
        placed = reconstruct_joints(cameras, seen.assign_people(index), fps, settings).triangulation
        assert placed.extra is not None
        points = np.concatenate([placed.joints, placed.extra.joints], axis=2)[:, 0]
        without = perceived_body(fit(replace(placed, extra=None), fps))
        sides = (points, without, perceived_body(fit(placed, fps)))
        for name, side in zip(names, sides, strict=True):
            found[name].append(distances(cameras[c], side, seen, c))
    print("\nleft-out cameras: median [px] and [mm], 90 % [mm]")
    for group, places in GROUPS.items():
        cells = []
        for name, each in found.items():
            values = np.concatenate([one[:, places].reshape(-1, 2) for one in each])
            values = values[np.isfinite(values).all(axis=1)]
            if len(values):
                pixels, metres = np.median(values, axis=0)
                high = 1e3 * np.quantile(values[:, 1], 0.9)
                cells.append(f"{name} {pixels:6.1f} {1e3 * metres:6.1f} {high:6.1f}")
        print(f"{group:12s} " + " | ".join(cells))
    placed = reconstruct_joints(cameras, seen, fps, settings).triangulation
    assert placed.extra is not None
    points = np.concatenate([placed.joints, placed.extra.joints], axis=2)[:, 0]
    both = {
        "triangulated": points,
        "bodies without feet": perceived_body(fit(replace(placed, extra=None), fps)),
        "bodies with feet": perceived_body(fit(placed, fps)),
    }
    pairs = {"shank": (13, 15), "ankle to heel": (15, 19), "heel to big toe": (19, 17)}
    print("\nlengths, mean and standard deviation over time [mm], left and right")
    for label, (a, b) in pairs.items():
        cells = []
        for joints in both.values():
            for mirror in (False, True):
                one, two = (m + (1 if m < 17 else 3) * mirror for m in (a, b))
                length = 1e3 * np.linalg.norm(joints[:, one] - joints[:, two], axis=-1)
                cells.append(f"{np.nanmean(length):6.1f} {np.nanstd(length):5.1f}")
        print(f"{label:16s} " + " | ".join(cells))
    last = fit(placed, fps)
    if last.extra is not None:
        print("\noffsets of the detector's points, left, up, forward [mm]")
        for point, offset in zip(last.extra.points, 1e3 * last.extra.offsets, strict=True):
            print(f"{point:16s} " + " ".join(f"{value:6.1f}" for value in offset))


if __name__ == "__main__":
    main()
