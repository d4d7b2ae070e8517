"""Code that several benchmarks share: a rig in a stadium's stands, and timing in turns."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping

import numpy as np

from worldpose.geometry import Camera, Rigid


def stadium_rig(count: int, rng: np.random.Generator, *, varied_lenses: bool) -> Camera:
    """Return cameras in the stands, each of which sees a part of the pitch.

    Args:
        count: number of cameras.
        rng: draws the cameras.
        varied_lenses: draw principal points and k2, too; else the image centre and 0.

    Returns:
        A batch (cameras,).
    """
    cameras = []
    for n in range(count):
        angle = 2 * np.pi * (n + rng.uniform(-0.2, 0.2)) / count
        center = np.array([85 * np.cos(angle), 65 * np.sin(angle), rng.uniform(14, 28)])
        forward = np.array([rng.uniform(-25, 25), rng.uniform(-15, 15), 0.0]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        focal = np.full(2, rng.uniform(1500, 2300))
        principal_point = np.array([960.0, 540.0])
        if varied_lenses:
            principal_point = principal_point + rng.normal(0, 8, 2)
        distortion = np.array([rng.uniform(-0.12, 0.02), 0.0, 0.0, 0.0, 0.0])
        if varied_lenses:
            distortion[1] = rng.uniform(-0.02, 0.04)
        cameras.append(
            Camera(
                focal=focal,
                principal_point=principal_point,
                distortion=distortion,
                cam_from_world=Rigid(rotation, -rotation @ center),
                image_size=np.array([1920, 1080]),
            )
        )
    return Camera.stack(cameras)


def best_seconds(sides: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the best wall time [s] of each side.

    All sides run in turns, in one round that is not measured and in `rounds` that are.
    """
    best = dict.fromkeys(sides, np.inf)
    for done in range(rounds + 1):
        for name, run in sides.items():
            start = time.perf_counter()
            run()
            if done:
                best[name] = min(best[name], time.perf_counter() - start)
        print(f"\r  round {done} of {rounds}", end="", file=sys.stderr, flush=True)
    print("\r" + " " * 30, end="\r", file=sys.stderr, flush=True)
    return best
