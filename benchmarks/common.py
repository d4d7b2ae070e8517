"""Code that several benchmarks share: rigs in a stadium, timing in turns, runs, distances."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import plan_run
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.store.store import Store


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


WORLDPOSE = Path(sys.executable).with_name("worldpose")


def run_worldpose(*words: object, accepted: Collection[int] = (0,)) -> str:
    """Run the command line quietly and return its output; end the program if it fails.

    Args:
        words: arguments.
        accepted: exit codes that are no failure.
    """
    done = subprocess.run(
        [WORLDPOSE, *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode not in accepted:
        sys.exit(f"worldpose {' '.join(map(str, words))}:\n{done.stdout}{done.stderr}")
    return done.stdout


def run_in_process(
    store: Store, folder: Path, until: str, iterations: int, overrides: dict[str, Any]
) -> tuple[str, list[dict[str, str]]]:
    """Compute missing results without Prefect and Dask, one unit after another.

    Returns:
        The match's id, and per iteration `stage/unit` to key.
    """
    match, _ = register(store, folder)
    names = [stage.name for stage in METHOD]
    stages = dict(zip(names, METHOD, strict=True))
    found = []
    for number in range(1, iterations + 1):
        last = until if number == iterations else names[-1]
        chosen = METHOD[: names.index(last) + 1]
        units = plan_run(store, match, overrides, chosen, iteration=number)
        for unit in units:
            recipe = unit.recipe
            if not store.has(match.match_id, recipe.stage, recipe.unit, unit.key):
                task_of(stages[recipe.stage]).fn(unit.work(store.url, match, "0001"))
        found.append({unit.name: unit.key for unit in units})
    return match.match_id, found


def distances_to_polyline(
    pixels: NDArray[np.float64], line: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distance of each pixel (n, 2) to a polyline (m, 2), NaN in gaps [px].

    Infinite where the polyline has no two finite neighbours.
    """
    start, step = line[:-1], np.diff(line, axis=0)
    whole = np.isfinite(start).all(axis=1) & np.isfinite(step).all(axis=1)
    start, step = start[whole], step[whole]
    if not len(start):
        return np.full(len(pixels), np.inf)
    offset = pixels[:, None] - start
    share = (offset * step).sum(axis=-1) / np.maximum((step**2).sum(axis=-1), 1e-12)
    nearest = offset - np.clip(share, 0.0, 1.0)[..., None] * step
    distances: NDArray[np.float64] = np.linalg.norm(nearest, axis=-1).min(axis=1)
    return distances


def print_held_out(label: str, figures: Mapping[str, float]) -> None:
    """Print how far bodies and triangulated joints are from keypoints of held-out cameras.

    Args:
        label: what the figures belong to.
        figures: those of a unit; nothing is printed for one without such distances.
    """
    for kind in ("fitted", "triangulated"):
        start = f"held_out_{kind}_m."
        groups = {
            name.removeprefix(start): 1000.0 * value
            for name, value in figures.items()
            if name.startswith(start)
        }
        if groups:
            print(f"{label}, {kind}, from held-out cameras, rms [mm]: ", end="")
            print(", ".join(f"{name} {value:.1f}" for name, value in groups.items()), end="")
            print(f"; mean {sum(groups.values()) / len(groups):.1f}", flush=True)
