"""Prints each stage's score on the Shelf sequence with few cameras and in short windows.

    python benchmarks/shelf_subsets.py DATA [--windows 211 121 60 30] [--cameras 2 3 4 5]
        [--first 421] [--iterations 2] [--until body_fitting] [--keep FOLDER]
        [--set STAGE.SETTING=JSON ...]

DATA holds `shelf_dev`, see `shelf.py`. Every subset of so many cameras is a separate match, and so
is every window of so many frames, in sequence from the first frame on (--first, or that of the
labels). The stages run in this process; with --keep, results already in the folder are not
recomputed. Scored are joints of `triangulation` (T), `retriangulation` (R), and bodies in the
definition of the body model (B) and of the detector (D), to which labels drawn by hand are closer:
PCP3D at alpha 0.5 and mean error [mm]. The last lines count the cases in which a stage is worse
than its input by more than 0.3 points or 1 mm.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import run_in_process
from shelf import load_scorer, read_settings, write_case

from worldpose.body_fitting.objective import perceived_joints
from worldpose.errors import WorldposeError
from worldpose.store.store import Store

POINTS, MILLIMETERS = 0.3, 1.0
"""Loss through a stage that counts as worse."""
LETTERS = {"triangulation": "T", "retriangulation": "R", "body_fitting": "B"}


def score(
    scorer: Any, truth: Any, store: Store, match: str, keys: dict[str, str], stage: str
) -> dict[str, tuple[float, float]]:
    """Return PCP3D [%] and the mean error of matched people [mm], by letter."""
    (unit,) = (name for name in keys if name.startswith(f"{stage}/"))
    _, name = unit.split("/")
    stored = store.open_result(match, stage, name, keys[unit])
    frames, joints = stored["frame"].values, stored["joints"].values
    by_letter = {LETTERS[stage]: joints}
    if stage == "body_fitting":
        by_letter["D"] = perceived_joints(joints, stored["joint_offsets"].values)
    scores: dict[str, tuple[float, float]] = {}
    for letter, places in by_letter.items():
        poses = dict(zip(frames.tolist(), places, strict=True))
        found, _ = scorer.evaluate(truth["gt"], truth["frames"], poses, "shelf", frames=frames)
        error = found["mpjpe_mm_matched"]
        scores[letter] = found["avg_pcp_actors_1_3"], np.nan if error is None else error
    return scores


def main() -> None:
    """Print one line per case and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--windows", type=int, nargs="+", default=[211, 121, 60, 30])
    parser.add_argument("--first", type=int, help="first frame; that of the labels if not given")
    parser.add_argument("--cameras", type=int, nargs="+", default=[5, 4, 3, 2])
    parser.add_argument("--without", nargs="*", default=[], help="subsets of these alone")
    parser.add_argument("--iterations", type=int, default=1)
    parser.add_argument("--until", default="body_fitting")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    options = parser.parse_args()
    data = options.data / "shelf_dev"
    overrides = read_settings(options.settings)
    scorer, truth = load_scorer(data), np.load(data / "gt.npz")
    every = sorted(file.stem for file in (data / "import" / "detections").glob("*.json"))
    first, last = int(truth["frames"][0]), int(truth["frames"][-1])
    first = options.first or first
    stages = ["triangulation", "retriangulation", "body_fitting"]
    stages = (
        stages[: 1 + max(1, stages.index(options.until))] if options.until in stages else stages
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        project = folder / "project"
        store = Store.open(project) if project.exists() else Store.create(project)
        worse: dict[str, list[str]] = {}
        for length, count in itertools.product(options.windows, options.cameras):
            for start in range(first, last + 2 - length, length):
                frames = range(start, start + length)
                for cameras in itertools.combinations(every, count):
                    if options.without and set(every) - set(cameras) != set(options.without):
                        continue
                    tell_case(
                        (data / "import", cameras, frames, folder),
                        (scorer, truth, store, stages),
                        (options.until, options.iterations, overrides),
                        worse,
                    )
    for comparison, cases in worse.items():
        bad = [case for case in cases if case]
        print(f"{comparison}: worse in {len(bad)} of {len(cases)}", *bad, sep="\n    ")


def tell_case(
    case: tuple[Path, tuple[str, ...], range, Path],
    scoring: tuple[Any, Any, Store, list[str]],
    how: tuple[str, int, dict[str, Any]],
    worse: dict[str, list[str]],
) -> None:
    """Print one case, and record stages that are worse than their input."""
    _, cameras, frames, _ = case
    scorer, truth, store, stages = scoring
    label = f"{''.join(c.removeprefix('cam') for c in cameras):5s} {frames.start}-{frames.stop - 1}"
    rows = np.isin(truth["frames"], frames)
    if not np.isfinite(truth["gt"][rows][:, [0, 2], 0, 0]).any():
        return
    try:
        match, found = run_in_process(store, write_case(*case), *how)
    except WorldposeError as error:
        print(f"{label}: {type(error).__name__}: {str(error).splitlines()[0]}", flush=True)
        return
    scores: dict[str, tuple[float, float]] = {}
    for number, keys in enumerate(found, 1):
        for stage in stages:
            if any(name.startswith(f"{stage}/") for name in keys):
                found_scores = score(scorer, truth, store, match, keys, stage)
                scores |= {f"{letter}{number}": pair for letter, pair in found_scores.items()}
    adjusted = store.open_result(
        match, "bundle_adjustment", "cameras", found[0]["bundle_adjustment/cameras"]
    )
    print(
        f"{label}  "
        + "  ".join(f"{name} {pcp:6.2f} {error:5.1f}" for name, (pcp, error) in scores.items())
        + f"  changed {int(adjusted['accepted'].values.sum())}",
        flush=True,
    )
    pairs = [("T1", "R1", True), ("R1", "B1", False), ("R1", "D1", False)]
    pairs += [("R1", "R2", True), ("B1", "B2", False), ("D1", "D2", False)]
    for before, after, both in pairs:
        if before in scores and after in scores:
            lost = scores[before][0] - scores[after][0]
            risen = scores[after][1] - scores[before][1]
            bad = lost > POINTS or (both and risen > MILLIMETERS)
            said = f"{label}: {-lost:+.2f} points, {risen:+.1f} mm" if bad else ""
            worse.setdefault(f"{before} to {after}", []).append(said)


if __name__ == "__main__":
    main()
