"""The Shelf sequence: whole runs, joint groups, subsets and pairs of its cameras."""

from __future__ import annotations

import itertools
import json
import re
import tempfile
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
from common import load_module, run_in_process, run_worldpose, tell
from registry import DATA, Table, Tables, benchmark, option

from flows.results.best_results import JointDefinition, joint_tracks
from worldpose.body_fitting.evidence import perceived_joints
from worldpose.errors import WorldposeError
from worldpose.ingest.importing import import_match
from worldpose.store.store import Store, open_run

FPS = 25.0

ALL_FRAMES = range(1_000_000)


STAGES = ("triangulation", "retriangulation", "body_fitting")

SCORED: tuple[tuple[str, JointDefinition], ...] = (
    *((stage, "detector") for stage in STAGES[:2]),
    *((STAGES[2], definition) for definition in ("body", "detector")),
)
"""Stages, and the definition of their joints."""

POINTS, MILLIMETERS = 0.3, 1.0
"""Loss through a stage that counts as worse."""

LETTERS = {"triangulation": "T", "retriangulation": "R", "body_fitting": "B"}


@benchmark("shelf", "Shelf through whole runs: all cameras, causally, without each camera", DATA)
def score_runs(options: Namespace) -> Tables:
    """DATA holds `shelf_dev`: `import/` (calibration.toml, detections), `gt.npz` and `pcp.py`.

    `pcp.py` is the sequence's own evaluator. Every row is a run by the command line; scored are the
    joints of `retriangulation` and the fitted bodies, in the definition of the body model and of
    the detector: PCP3D of actors 1 and 3 at alpha 0.5.
    """
    data = options.data / "shelf_dev"
    cameras = list_cameras(data)
    runs: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
        "all cameras": (cameras, ()),
        "causal": (cameras, ("--set", "tracking.causal=true")),
        **{
            f"without {camera}": (tuple(c for c in cameras if c != camera), ())
            for camera in cameras
        },
    }
    rows = []
    for label, (chosen, settings) in runs.items():
        with tempfile.TemporaryDirectory() as temporary:
            match = write_case(data / "import", chosen, ALL_FRAMES, Path(temporary))
            rows.append([label, *scores(data, match, Path(temporary), *settings)])
        tell(str(rows[-1]))
    columns = ["cameras", "joints", "bodies", "bodies as detected"]
    return {"pcp3d": Table("PCP3D", columns, rows, "%")}


def list_cameras(data: Path) -> tuple[str, ...]:
    """Return the names of the cameras."""
    return tuple(sorted(file.stem for file in (data / "import" / "detections").glob("*.json")))


def scores(data: Path, match: Path, folder: Path, *settings: str) -> list[float]:
    """Return PCP3D of retriangulated joints and of bodies in both definitions [%]."""
    scorer, truth = load_module(data / "pcp.py"), np.load(data / "gt.npz")
    run_worldpose("run", match, "--project", folder / "project", *settings)
    run, values = open_run(str(folder / "project"), match.name), []
    for stage, definition in SCORED[1:]:
        tracks = joint_tracks(run, "clip", stage, definition)
        poses = dict(zip(tracks.frames.tolist(), tracks.joints, strict=True))
        score, _ = scorer.evaluate(truth["gt"], truth["frames"], poses, "shelf")
        values.append(float(score["avg_pcp_actors_1_3"]))
    return values


def write_case(given: Path, cameras: tuple[str, ...], frames: range, folder: Path) -> Path:
    """Return the match folder of some cameras and frames."""
    name = "-".join(camera.removeprefix("cam") for camera in cameras)
    match = folder / "matches" / f"shelf-{name}-{frames.start}-{frames.stop - 1}"
    if match.exists():
        return match
    with tempfile.TemporaryDirectory() as temporary:
        detections = Path(temporary) / "detections"
        detections.mkdir()
        for camera in cameras:
            people = json.loads((given / "detections" / f"{camera}.json").read_text())
            kept = [person for person in people if person["image_id"] in frames]
            (detections / f"{camera}.json").write_text(json.dumps(kept))
        parts = re.split(r"(?m)^(?=\[)", (given / "calibration.toml").read_text())
        calibration = Path(temporary) / "calibration.toml"
        calibration.write_text(
            "".join(p for p in parts if any(f'name = "{camera}"' in p for camera in cameras))
        )
        import_match(calibration, detections, FPS, match)
    return match


@benchmark(
    "shelf_subsets",
    "Shelf with few cameras and in short windows: each stage against its input",
    DATA,
    option("--windows", type=int, nargs="+", default=[211, 121, 60, 30], help="lengths [frame]"),
    option("--first", type=int, help="first frame; that of the labels if not given"),
    option("--cameras", type=int, nargs="+", default=[5, 4, 3, 2], help="numbers of cameras"),
)
def score_subsets(options: Namespace) -> Tables:
    """Every subset of cameras is a match, and so is every window of frames, in sequence.

    Scored are joints of `triangulation` (T), `retriangulation` (R), and bodies in the definition of
    the body model (B) and of the detector (D): PCP3D at alpha 0.5 and mean error. The second table
    counts the cases in which a stage is worse than its input by more than 0.3 points or 1 mm.
    """
    data = options.data / "shelf_dev"
    scorer, truth = load_module(data / "pcp.py"), np.load(data / "gt.npz")
    every, last = list_cameras(data), int(truth["frames"][-1])
    first = options.first or int(truth["frames"][0])
    rows: list[list[Any]] = []
    worse: dict[str, list[bool]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        store = Store.open_or_new(str(folder / "project"))
        for length, number in itertools.product(options.windows, options.cameras):
            windows = [range(n, n + length) for n in range(first, last + 2 - length, length)]
            for frames, cameras in itertools.product(
                windows, itertools.combinations(every, number)
            ):
                shown = np.isin(truth["frames"], frames)
                if not np.isfinite(truth["gt"][shown][:, [0, 2], 0, 0]).any():
                    continue
                label = f"{' '.join(cameras)}, {frames.start} to {frames.stop - 1}"
                try:
                    folder_of_case = write_case(data / "import", cameras, frames, folder)
                    match, (keys,) = run_in_process(store, folder_of_case, STAGES[-1], 1, {})
                except WorldposeError as error:
                    rows.append([label, type(error).__name__, None, None])
                    continue
                marks: dict[str, tuple[float, float]] = {}
                for stage in (each for each in STAGES if f"{each}/clip" in keys):
                    marks |= score(scorer, truth, store, match, keys, stage)
                rows += [[label, name, *pair] for name, pair in marks.items()]
                for before, after in itertools.pairwise(("T", "R", "B")):
                    if after in marks:
                        lost = marks[before][0] - marks[after][0]
                        risen = marks[after][1] - marks[before][1] if after == "R" else 0.0
                        is_bad = lost > POINTS or risen > MILLIMETERS
                        worse.setdefault(f"{before} to {after}", []).append(is_bad)
                tell(f"{label} {marks}")
    counts = [[name, sum(cases), len(cases)] for name, cases in worse.items()]
    return {
        "cases": Table("cases", ["case", "joints", "PCP3D [%]", "error [mm]"], rows),
        "worse": Table("worse than the input", ["step", "cases", "of"], counts),
    }


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
