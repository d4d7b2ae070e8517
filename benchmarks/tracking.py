"""Prints speed and accuracy of person association, next to simple peers in the same run.

    python benchmarks/tracking.py [--frames 100] [--people 22] [--rounds 5]

Sixteen cameras around a pitch, detections in any order, 15 % missed, one false positive per view,
1.5 px noise. Association takes the true poses of the previous frame, so all methods solve the same
problem; all sides take turns in one process with one thread and the best round of each counts. The
loops are typical research code, joint by joint, and are timed on one frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from common import best_seconds, stadium_rig
from scipy.optimize import linear_sum_assignment

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.tracking.epipolar import associate
from worldpose.tracking.ray_matching import match_greedily, match_optimally, ray_affinity
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

SETTINGS = TrackingSettings()
CAMERAS, FPS, GATE = 16, 50.0, SETTINGS.gate_m
SKELETON = np.array(
    [
        [(0.10, 0.00, 1.65), (0.08, 0.03, 1.69), (0.08, -0.03, 1.69), (0.02, 0.07, 1.67)],
        [(0.02, -0.07, 1.67), (0.00, 0.19, 1.45), (0.00, -0.19, 1.45), (0.02, 0.25, 1.17)],
        [(0.02, -0.25, 1.17), (0.10, 0.27, 0.93), (0.10, -0.27, 0.93), (0.00, 0.13, 0.95)],
        [(0.00, -0.13, 0.95), (0.05, 0.13, 0.52), (0.05, -0.13, 0.52), (0.00, 0.13, 0.09)],
    ]
).reshape(-1, 3)
SKELETON = np.concatenate([SKELETON, [(0.0, -0.13, 0.09)]])


def crowd(frames: int, people: int, rng: np.random.Generator) -> np.ndarray:
    """Return joints (frames, people, 17, 3) [m] of people who run to and fro."""
    phase, turn = rng.uniform(0, 6.28, (2, people, 2))
    middle = rng.uniform([-40, -25], [40, 25], (people, 2))
    time_ = np.arange(frames)[:, None, None] / FPS
    ground = middle + 5.0 * np.sin(time_ * (0.5 + turn / 6.28) + phase)
    joints = np.broadcast_to(SKELETON, (frames, people, 17, 3)).copy()
    joints[..., :2] += ground[:, :, None]
    return joints


def detections(
    cameras: Camera, joints: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints (frames, cameras, detections, 17, 2) and their persons, -1 for none."""
    frames, people = joints.shape[:2]
    keypoints = np.full((frames, CAMERAS, people + 1, 17, 2), np.nan)
    owner = np.full(keypoints.shape[:3], -1)
    for t in range(frames):
        image = cameras.project(joints[t].reshape(1, -1, 3)).reshape(CAMERAS, people, 17, 2)
        image += rng.normal(0, 1.5, image.shape)
        inside = np.all((image > 0) & (image < [1920, 1080]), axis=(2, 3))
        for c in range(CAMERAS):
            who = rng.permutation(np.flatnonzero(inside[c] & (rng.random(people) > 0.15)))
            false = image[c, rng.integers(people)] + rng.uniform(80, 300, 2)
            keypoints[t, c, : len(who) + 1] = np.concatenate([image[c, who], false[None]])
            owner[t, c, : len(who)] = who
    return keypoints, owner


def numpy_affinity(joints: np.ndarray, centers: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return minus mean point-to-ray distances (cameras, people, detections) in a few lines."""
    offset = joints[None] - centers[:, None, None]
    along = np.einsum("cijx,cdjx->cidj", offset, rays, optimize=True)
    squared = (offset**2).sum(-1)[:, :, None] - along**2
    mean = np.sqrt(np.maximum(squared, 0.0)).mean(-1)
    return np.where(np.isfinite(mean), -mean, -np.inf)


def loop_affinity(joints: np.ndarray, centers: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the same mean distances, joint by joint."""
    affinity = np.full((len(rays), len(joints), rays.shape[1]), -np.inf)
    for c, person, detection in np.ndindex(affinity.shape):
        if np.isfinite(rays[c, detection, 0, 0]):
            affinity[c, person, detection] = -np.mean(
                [
                    np.linalg.norm(np.cross(joint - centers[c], ray))
                    for joint, ray in zip(joints[person], rays[c, detection], strict=True)
                ]
            )
    return affinity


def numpy_greedy(affinity: np.ndarray) -> np.ndarray:
    """Return each person's detection, best pairs first."""
    index = np.full(affinity.shape[:2], -1)
    for c, gains in enumerate(affinity):
        taken: set[int] = set()
        for place in np.argsort(-gains, axis=None):
            person, detection = divmod(int(place), gains.shape[1])
            if gains[person, detection] < -GATE:
                break
            if index[c, person] < 0 and detection not in taken:
                index[c, person] = detection
                taken.add(detection)
    return index


def hungarian(affinity: np.ndarray) -> np.ndarray:
    """Return each person's detection by scipy's assignment."""
    index = np.full(affinity.shape[:2], -1)
    for c, gains in enumerate(affinity):
        row, column = linear_sum_assignment(np.where(gains < -GATE, 1e3, -gains))
        good = gains[row, column] >= -GATE
        index[c, row[good]] = column[good]
    return index


def numpy_epipolar(centers: np.ndarray, rays: np.ndarray) -> list[np.ndarray]:
    """Return ray-to-ray distances of all detections of all pairs of cameras."""
    tables = []
    for a in range(len(rays)):
        for b in range(a + 1, len(rays)):
            normal = np.cross(rays[a][:, None], rays[b][None])
            length = np.linalg.norm(normal, axis=-1) + 1e-9
            tables.append((abs(normal @ (centers[b] - centers[a])) / length).mean(-1))
    return tables


def run_frames(run: Callable[[int], Any], count: int) -> list[Any]:
    """Return the results of a method in the first frames."""
    return [run(t) for t in range(count)]


def main() -> None:
    """Print one line per method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--people", type=int, default=22)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    rng = np.random.default_rng(4)
    cameras = stadium_rig(CAMERAS, rng, varied_lenses=False)
    joints = crowd(options.frames + 1, options.people, rng)
    keypoints, owner = detections(cameras, joints[1:], rng)
    frames, few = range(options.frames), range(min(10, options.frames))
    shape = (options.frames, CAMERAS, -1, 17, 3)
    image = keypoints.reshape(options.frames, CAMERAS, -1, 2)
    rays = cameras.unproject(image).directions.reshape(shape)
    weights = np.where(np.isfinite(rays[..., 0]), 1.0, 0.0)
    centers, gates = np.ascontiguousarray(cameras.center), np.full((CAMERAS, options.people), GATE)

    def ours(t: int) -> np.ndarray:
        return ray_affinity(joints[t], centers, rays[t], weights[t], gates, SETTINGS.min_joints)

    methods: dict[str, Callable[[int], np.ndarray]] = {
        "ours, Hungarian": lambda t: match_optimally(ours(t), -GATE),
        "ours, greedy": lambda t: match_greedily(ours(t)),
        "numpy, Hungarian": lambda t: hungarian(numpy_affinity(joints[t], centers, rays[t])),
        "numpy, greedy": lambda t: numpy_greedy(numpy_affinity(joints[t], centers, rays[t])),
        "loops, greedy": lambda t: numpy_greedy(loop_affinity(joints[t], centers, rays[t])),
    }
    starts: dict[str, Callable[[int], Any]] = {
        "ours, ground gate": lambda t: associate(centers, rays[t], weights[t], True, SETTINGS),
        "ours, no ground": lambda t: associate(centers, rays[t], weights[t], False, SETTINGS),
        "numpy, pair distances only": lambda t: numpy_epipolar(centers, rays[t]),
    }
    print(f"{options.people} people, {CAMERAS} cameras, best of {options.rounds}, one thread")
    for title, table in (("association", methods), ("first frame", starts)):
        count = {name: 1 if "loops" in name else len(few) for name in table}
        sides = {name: partial(run_frames, run, count[name]) for name, run in table.items()}
        best = best_seconds(sides, options.rounds)
        first = best[next(iter(best))] / len(few)
        for name, run in table.items():
            seconds = best[name] / count[name]
            line = f"{title:12s} {name:28s} {1e3 * seconds:9.3f} ms   ratio {seconds / first:8.1f}"
            if title == "association":
                line += "   recall {:.4f} precision {:.4f}".format(
                    *figures(run_frames(run, count[name]), owner)
                )
            print(line)
    seen = KeypointDetections.from_keypoints(keypoints, np.full(keypoints.shape[:-1], 0.9))
    start = time.perf_counter()
    result = track_people(cameras, seen, FPS, SETTINGS, pitch_size=(105.0, 68.0))
    seconds = time.perf_counter() - start
    print(
        f"whole stage  {len(frames) / seconds:.0f} frames/s, {len(result.person)} people found, "
        f"{result.report.undecided} joins undecided"
    )


def figures(matches: list[np.ndarray], owner: np.ndarray) -> tuple[float, float]:
    """Return recall and precision of matches [(cameras, people)] of the first frames."""
    index = np.stack(matches)
    true = np.take_along_axis(owner[: len(index)], np.maximum(index, 0), axis=2)
    right = ((true == np.arange(index.shape[2])) & (index >= 0)).sum()
    return right / (owner[: len(index)] >= 0).sum(), right / (index >= 0).sum()


if __name__ == "__main__":
    main()
