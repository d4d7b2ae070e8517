"""Consistency of a real demo run with its own images, as there is no ground truth.

Prints durations of tracks, reprojection residuals of joints, and variation of bone lengths, and
writes a video of one view with joints drawn over it.
Example: python score.py real-demo/match real-demo/project real-demo/overlay.mp4
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import worldpose
from data_contracts.conventions import COCO17_BONES
from flows.results.best_results import bodies_unit, joint_tracks, placed_joints
from flows.results.run_cameras import static_cameras
from worldpose.ingest.match_folder import read_match
from worldpose.video.files import VideoReader, write_video

LIMBS = {
    "thigh": ((11, 13), (12, 14)),
    "shank": ((13, 15), (14, 16)),
    "upper arm": ((5, 7), (6, 8)),
    "forearm": ((7, 9), (8, 10)),
}
COLOURS = ((255, 200, 0), (0, 200, 255), (255, 80, 200), (120, 255, 120))


def steadiness(joints: NDArray[np.float64]) -> str:
    """Return limb lengths and their variation in words; joints (frames, 17, 3) [m]."""
    parts = []
    for limb, sides in LIMBS.items():
        lengths = [np.linalg.norm(joints[:, a] - joints[:, b], axis=-1) for a, b in sides]
        each = ", ".join(
            f"{100 * np.nanmedian(one):.1f} +- {100 * np.nanstd(one):.1f} cm" for one in lengths
        )
        parts.append(f"{limb} {each}")
    return "; ".join(parts)


def score(folder: Path, project: str, video: Path) -> None:
    """Print the metrics of the latest run and write the overlay video."""
    match = read_match(folder)
    run = worldpose.open_run(project, match.spec.match_id)
    clip = match.spec.clips[0].id
    placed = placed_joints(run, clip)
    joints, smoothed = placed["joints"].values, placed["smoothed"].values
    inliers = placed["inliers"].transpose("frame", "camera", "person", "joint").values
    index = run[f"tracking/{clip}"]["detection_index"].values
    cameras = static_cameras(run, match.spec)
    bodies = bodies_unit(run, clip)
    kinds = {"placed frame by frame": joints, "smoothed": smoothed}
    if bodies in run:
        kinds["of the body"] = run[bodies]["joints"].values
    frames = len(joints)
    print(f"{frames} frames, {joints.shape[1]} people")
    every, used = [], []
    for person in range(joints.shape[1]):
        seen = (index[:, :, person] >= 0).sum(axis=1)
        there = np.isfinite(joints[:, person]).all(axis=-1).any(axis=-1)
        print(f"person {person}: placed in {there.sum()} frames, {seen.mean():.1f} views a frame")
        for number, (name, camera) in enumerate(cameras.items()):
            keypoints = run[f"detection/{name}.{clip}"]["keypoints"].values
            rows = np.flatnonzero(index[:, number, person] >= 0)
            found = keypoints[rows, index[rows, number, person]]
            error = np.linalg.norm(camera.project(joints[rows, person]) - found, axis=-1)
            every.append(error.ravel())
            used.append(error[inliers[rows, number, person]])
        for kind, placed_so in kinds.items():
            print(f"  {kind}: {steadiness(placed_so[:, person])}")
    for name, errors in (("all keypoints", every), ("those that carry joints", used)):
        print(f"median reprojection error of {name}: {np.nanmedian(np.concatenate(errors)):.1f} px")
    tracks = joint_tracks(run, clip)
    name = next(iter(cameras))
    pictures = []
    with VideoReader(match.videos[name]) as reader:
        for row, (_, picture) in enumerate(reader.frames(0, frames)):
            drawn = picture.copy()
            for person in range(tracks.joints.shape[1]):
                pixels = cameras[name].project(tracks.joints[row, person])
                for a, b in COCO17_BONES:
                    if np.isfinite(pixels[[a, b]]).all():
                        start, end = pixels[[a, b]].astype(int).tolist()
                        color = COLOURS[person % len(COLOURS)]
                        cv2.line(drawn, start, end, color, 4, cv2.LINE_AA)
            pictures.append(drawn)
    write_video(video, pictures, match.spec.fps)
    print(f"wrote {video}, view {name}")


if __name__ == "__main__":
    score(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
