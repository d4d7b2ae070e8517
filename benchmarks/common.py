"""Code that benchmarks share: rigs, timing in turns, runs, distances, files."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from registry import Table

from data_contracts.arrays import Floats, Image
from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import plan_run
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import Scene, simulate_scene
from worldpose.simulation.settings import Scenario
from worldpose.store.store import Store

WORLDPOSE = Path(sys.executable).with_name("worldpose")

RowOf = Callable[[str], Sequence[Any]]


def compare_times(
    title: str,
    sides: Mapping[str, Callable[[], object]],
    rounds: int,
    *columns: str,
    more: RowOf = lambda _: (),
    scale: Mapping[str, float] | None = None,
) -> Table:
    """Return the best times of all sides, which run in turns, and their ratios to the first side.

    `more` returns the values of the further columns by side; a side that did a part of the work has
    its time multiplied by `scale`.
    """
    best = best_seconds(sides, rounds)
    best = {name: seconds * (scale or {}).get(name, 1.0) for name, seconds in best.items()}
    ours = next(iter(best.values()))
    rows = [[name, 1e3 * each, each / ours, *more(name)] for name, each in best.items()]
    return Table(title, ["side", "time [ms]", "times ours", *columns], rows)


def tell(text: str) -> None:
    """Print progress where tables do not go."""
    print(text, file=sys.stderr, flush=True)


def simulate(name: str, seed: int, duration: float | None = None) -> tuple[Scenario, Scene]:
    """Return a scenario without its moving camera, and its scene."""
    changes = {"broadcast": ()} | ({} if duration is None else {"duration": duration})
    scenario = SCENARIOS[name].model_copy(update=changes)
    return scenario, simulate_scene(scenario, seed)


def places_of_feet(joints: Floats, pitch: PitchTemplate) -> Floats:
    """Return where people stand (n, 3) [m], on the surface of the pitch."""
    places: Floats = joints[:, :, 15:17].mean(axis=2).reshape(-1, 3)
    places[:, 2] = pitch.height(places[:, 0], places[:, 1])
    return places


def quantile(values: Floats, share: float = 0.5) -> float:
    """Return a quantile; NaN without values."""
    return float(np.nanquantile(values, share)) if np.isfinite(values).any() else np.nan


def read_changes(words: Sequence[str]) -> dict[str, Any]:
    """Return one stage's settings from NAME=VALUE."""
    return dict(word.split("=", 1) for word in words)


def load_module(file: Path) -> ModuleType:
    """Return a data set's own scorer."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(f"no scorer {file}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def git(*arguments: str) -> bytes:
    """Run git and return its output."""
    return subprocess.run(["git", *arguments], check=True, stdout=subprocess.PIPE).stdout


def clone_repository(clones: Path, repository: str) -> str:
    """Return a clone of a public repository; one in the folder takes the place of the network."""
    clone = clones / repository.replace("/", "+")
    if not clone.is_dir():
        url = f"https://github.com/{repository}"
        git("clone", "--quiet", "--no-checkout", "--filter=blob:none", url, str(clone))
    return str(next(each for each in (clone / "repo", clone) if each.is_dir()))


def fetch_file(clones: Path, repository: str, commit: str, path: str) -> bytes:
    """Return a file of a public repository; git checks the content by its commit."""
    clone = clone_repository(clones, repository)
    return git("-C", clone, "cat-file", "blob", f"{commit}:{path}")


def read_image(content: bytes) -> Image:
    """Return the image (height, width, 3), in OpenCV's order of colours, of a file's content."""
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise SystemExit("expected an image, found other bytes")
    return np.asarray(picture, np.uint8)


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


def run_worldpose(*words: object, accepted: Collection[int] = (0,)) -> str:
    """Run the command line quietly and return its output; end the program if it fails.

    Exit codes `accepted` are no failure.
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


def distances_to_polyline(pixels: Floats, line: Floats) -> Floats:
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
    distances: Floats = np.linalg.norm(nearest, axis=-1).min(axis=1)
    return distances
