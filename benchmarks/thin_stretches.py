"""Prints the effect of monocular poses (S4) on chunks with few cameras, through whole runs.

    python benchmarks/thin_stretches.py [--seeds 825 826 827 828] [--duration 2] [--keep FOLDER]

Scenario `tiny-broadcast` with 12 people and exact static cameras. For 0.6 to 1.2 s, each person
keeps the detections of one of the static cameras that see the person, every second person those of
two: the others' detections are removed from the match folder. Then the steps of `worldpose run
--iterations 2` run with the estimates of the folder, with errors of 80 mm after alignment. The
second refitting is repeated without them, from the same tracks, joints and cameras, and so is the
whole run. Broadcast keypoints are in all. Errors are of the second iteration's bodies against the
truth, of people in the broadcast image, in those chunks, wherever both have a body within half a
metre. Whole runs recompute identities, which changes errors in either direction by more than
estimates do.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats
from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import PlannedUnit, plan_run
from flows.stages import refitting
from worldpose.formats.archives import write_archive
from worldpose.formats.joints_file import read_joints
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store

SCENARIO, PEOPLE = SCENARIOS["tiny-broadcast"], 12
LENGTH = (0.6, 1.2)
"""Duration of a chunk [s]."""
FIRST = 0.3
"""Earliest beginning of a chunk, and minimum time after it [s]: tracks begin and end in full
view."""
FAR = 0.5
"""Bodies farther from all persons belong to none [m]."""


def run(store: Store, folder: Path, iterations: int) -> tuple[str, list[PlannedUnit]]:
    """Run the steps of `worldpose run FOLDER --iterations N` in this process.

    Returns:
        The match's id and all units of the last iteration.
    """
    match, _ = register(store, folder)
    stages = {stage.name: stage for stage in METHOD}
    units: list[PlannedUnit] = []
    for number in range(1, iterations + 1):
        units = plan_run(store, match, {}, iteration=number)
        for unit in units:
            if not store.has(match.match_id, unit.recipe.stage, unit.recipe.unit, unit.key):
                task_of(stages[unit.recipe.stage]).fn(unit.work(store.url, match, "0001"))
    return match.match_id, units


def thin(match: Path, seed: int, fps: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Remove detections from a match folder.

    Returns:
        (frames, persons) number of remaining static cameras; -1 where no camera was removed. And
        (frames, persons), whether the broadcast camera has a detection of the person.
    """
    rng = np.random.default_rng([seed, 7])
    identities = {
        file.stem: np.load(file)["person"]
        for file in sorted((match / "reference" / "identities").glob("*.npz"))
    }
    people = len(read_joints(match / "reference" / "joints.npz").person_ids)
    frames = len(identities["clip"])
    sees = {
        name: (person[:, :, None] == np.arange(people)).any(axis=1)
        for name, person in identities.items()
    }
    names = [name for name in identities if name != "clip"]
    left = np.full((frames, people), -1)
    taken = {name: np.zeros((frames, people), dtype=bool) for name in names}
    for person in range(people):
        length = round(fps * rng.uniform(*LENGTH))
        margin = round(fps * FIRST)
        first = int(rng.integers(margin, frames - margin - length + 1))
        order, most = rng.permutation(len(names)), 1 + person % 2
        for frame in range(first, first + length):
            there = [names[c] for c in order if sees[names[c]][frame, person]]
            left[frame, person] = min(most, len(there))
            for name in there[most:]:
                taken[name][frame, person] = True
    for name in names:
        file = match / "detections" / f"{name}.npz"
        with np.load(file) as stored:
            arrays = {key: stored[key] for key in stored.files}
        rows, place = np.nonzero(identities[name] >= 0)
        gone = taken[name][rows, identities[name][rows, place]]
        for key in ("keypoints", "confidence", "boxes", "score"):
            arrays[key][rows[gone], place[gone]] = np.nan
        write_archive(file, arrays)
    return left, sees["clip"]


def refitted_joints(store: Store, match: Path, *, without: bool = False) -> Floats:
    """Return the bodies' joints (frames, persons, 17, 3) [m] of the second iteration.

    Args:
        store: the store.
        match: the match folder.
        without: of the same run, but refitted without estimates.
    """
    match_id, units = run(store, match, 2)
    (unit,) = (unit for unit in units if unit.recipe.stage == "refitting")
    key = unit.key
    if without:
        sources = unit.recipe.sources | {"estimates": None, "estimates_sha256": None}
        recipe = unit.recipe.model_copy(update={"sources": sources})
        key = recipe_key(recipe)
        work = replace(unit, recipe=recipe, key=key).work(
            store.url, register(store, match)[0], "0001"
        )
        task_of(refitting.STAGE).fn(work)
    found: Floats = store.open_result(match_id, "refitting", "clip", key)["joints"].values
    return found


def errors(found: Floats, match: Path) -> Floats:
    """Return the mean joint error (frames, persons of the truth) [mm] of bodies."""
    truth = read_joints(match / "reference" / "joints.npz").joints
    away = np.linalg.norm(found[:, :, None] - truth[:, None], axis=-1).mean(axis=-1)
    out = np.full(truth.shape[:2], np.nan)
    for frame, apart in enumerate(np.where(np.isfinite(away), away, 9.0)):
        person, who = linear_sum_assignment(np.minimum(apart, FAR))
        near = apart[person, who] < FAR
        out[frame, who[near]] = 1e3 * apart[person[near], who[near]]
    return out


def measure(folder: Path, seed: int, duration: float) -> dict[str, tuple[int, float, float]]:
    """Return the number of bodies, and their errors without and with estimates [mm]."""
    match = folder / "match"
    crowd = SCENARIO.crowd.model_copy(update={"people": PEOPLE})
    scenario = SCENARIO.model_copy(update={"crowd": crowd})
    given, aside = match / "estimates" / "clip.npz", folder / "estimates.npz"
    if not match.exists():
        simulate_match(
            scenario, seed, match, MatchOptions(duration=duration, calibrated=True, stills=False)
        )
    elif aside.exists():
        aside.rename(given)
    left, filmed = thin(match, seed, scenario.fps)
    store = Store.open_or_new(folder / "project")
    helped = errors(refitted_joints(store, match), match)
    alone = errors(refitted_joints(store, match, without=True), match)
    given.rename(aside)
    apart = errors(refitted_joints(store, match), match)
    rows = {}
    for about, other in (("", alone), ("whole runs, ", apart)):
        counted = filmed & np.isfinite(helped) & np.isfinite(other)
        for label, some in (
            ("one", left == 1),
            ("two", left == 2),
            ("both", left > 0),
            ("others", left < 0),
        ):
            at = counted & some
            rows[about + label] = (int(at.sum()), float(other[at].mean()), float(helped[at].mean()))
    return rows


def main() -> None:
    """Print one line per seed, and the means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[825, 826, 827, 828])
    parser.add_argument("--duration", type=float, default=2.0)
    parser.add_argument(
        "--keep", type=Path, help="where matches and results are left, and found again"
    )
    options = parser.parse_args()
    rows = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) if options.keep is None else options.keep / str(seed)
            folder.mkdir(parents=True, exist_ok=True)
            rows.append(measure(folder, seed, options.duration))
        print(f"seed {seed}: {_line(rows[-1:])}", flush=True)
    print(f"mean: {_line(rows)}")


def _line(rows: list[dict[str, tuple[int, float, float]]]) -> str:
    """Return errors by cameras left, with equal weight per body."""
    parts = []
    for label in rows[0]:
        counts = [row[label][0] for row in rows]
        alone, helped = (
            np.average([row[label][k] for row in rows], weights=counts) for k in (1, 2)
        )
        change = 100.0 * (helped / alone - 1.0)
        parts.append(f"{label} {sum(counts)}: {alone:.1f} to {helped:.1f} mm ({change:+.1f} %)")
    return "; ".join(parts)


if __name__ == "__main__":
    main()
