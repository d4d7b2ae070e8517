"""Triangulate COCO keypoints of several calibrated, synchronized cameras.

    python examples/triangulate_coco.py calibration.toml detections 25 joints.npz

The calibration has one of the forms of docs/reference/formats.md#calibrations, such as Anipose's
TOML. The folder has one COCO results file per camera, `<camera>.json`.
"""

import sys
from pathlib import Path

import numpy as np

import worldpose as wp


def main() -> None:
    """Track people over all cameras, triangulate their joints, and write them."""
    calibration, folder, fps, out = sys.argv[1:]
    known = wp.read_cameras(calibration)
    files = {name: Path(folder) / f"{name}.json" for name in known}
    names = [name for name, file in files.items() if file.exists()]
    if len(names) < 2:
        sys.exit(f"{folder}: expected files of two cameras of {', '.join(known)}, found {names}")
    cameras = wp.Camera.stack([known[name] for name in names])
    seen = wp.KeypointDetections.stack([wp.read_observations(files[name]) for name in names])

    tracks = wp.track_people(cameras, seen, float(fps))
    people = seen.assign_people(tracks.detection_index)
    joints = wp.reconstruct_joints(cameras, people, float(fps))  # smoothed over time

    wp.write_joints(
        out,
        wp.JointTracks(seen.frame, tracks.person, joints.joints, joints.covariance, joints.views),
    )
    report = joints.report
    placed = np.isfinite(joints.joints[..., 0]).mean()
    print(f"{len(tracks.person)} people, {placed:.1%} of their joints in {len(seen.frame)} frames")
    print(report.model_dump_json(indent=2))


if __name__ == "__main__":
    main()
