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
from registry import DATA, Table, Tables, benchmark, integer, option

from data_contracts.run import RunRecord
from flows.results.best_results import JointDefinition, joint_tracks
from worldpose.errors import WorldposeError
from worldpose.ingest.importing import import_match
from worldpose.store.store import Run, Store, open_run

FPS = 25.0

ALL_FRAMES = range(1_000_000)


SCORED: tuple[tuple[str, str | None, JointDefinition], ...] = (
    ("T", "triangulation", "body"),
    ("R", "retriangulation", "body"),
    ("B", "body_fitting", "body"),
    ("D", "body_fitting", "detector"),
    ("E", None, "detector"),
)
"""Letter, stage and definition of joints; no stage = what an export has by default."""

AWAY_M = 0.2
"""Mean distance from which a person is another one [m]."""

NOBODY = np.zeros((0, 17, 3))


@benchmark("shelf", "Shelf through whole runs: all cameras, causally, without each camera", DATA)
def score_runs(options: Namespace) -> Tables:
    """DATA holds `shelf_dev`: `import/` (calibration.toml, detections), `gt.npz` and `pcp.py`.

    `pcp.py` is the sequence's own evaluator. Every row is a run by the command line; scored are the
    joints of `retriangulation`, the fitted bodies, in the definition of the body model and of the
    detector, and what an export has by default: PCP3D of actors 1 and 3 at alpha 0.5.
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
    columns = ["cameras", "joints", "bodies", "bodies as detected", "exported joints"]
    return {"pcp3d": Table("PCP3D", columns, rows, "%")}


def list_cameras(data: Path) -> tuple[str, ...]:
    """Return the names of the cameras."""
    return tuple(sorted(file.stem for file in (data / "import" / "detections").glob("*.json")))


def scores(data: Path, match: Path, folder: Path, *settings: str) -> list[float]:
    """Return PCP3D of retriangulated joints, of bodies in both definitions, of the export [%]."""
    scorer, truth = load_module(data / "pcp.py"), np.load(data / "gt.npz")
    run_worldpose("run", match, "--project", folder / "project", *settings)
    run, values = open_run(str(folder / "project"), match.name), []
    for _, stage, definition in SCORED[1:]:
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
    "Shelf with few cameras and in short windows: joints, bodies, the export, identities",
    DATA,
    option("--windows", type=int, nargs="+", default=[211], help="lengths of matches [frame]"),
    option("--first", type=int, help="first frame; that of the labels if not given"),
    option("--shown", type=int, default=421, help="frames from this one on are scored apart"),
    option("--cameras", type=int, nargs="+", default=[5, 4, 3], help="numbers of cameras"),
    option("--without", nargs="*", default=[], help="the subset without these alone"),
    integer("iterations", 1),
    option("--until", default="body_fitting"),
    option("--keep", type=Path, help="folder whose results are not recomputed"),
)
def score_subsets(options: Namespace) -> Tables:
    """Every subset of cameras is a match, and so is every window of frames, in sequence.

    Scored are joints of `triangulation` (T) and `retriangulation` (R), bodies in the definition of
    the body model (B) and of the detector (D), and what an export has by default (E): PCP3D at
    alpha 0.5 and mean error. `away` is the longest time for which an actor has nobody within
    0.2 m. The further table has the means and the worst over the subsets.
    """
    data = options.data / "shelf_dev"
    scorer, truth = load_module(data / "pcp.py"), np.load(data / "gt.npz")
    every, last = list_cameras(data), int(truth["frames"][-1])
    first = options.first or int(truth["frames"][0])
    rows: list[list[Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        store = Store.open_or_new(str(folder / "project"))
        for length, number in itertools.product(options.windows, options.cameras):
            windows = [range(n, n + length) for n in range(first, last + 2 - length, length)]
            for frames, cameras in itertools.product(
                windows, itertools.combinations(every, number)
            ):
                rest = set(every) - set(cameras)
                if options.without and rest != set(options.without):
                    continue
                label = f"{' '.join(cameras)}, {frames.start} to {frames.stop - 1}"
                try:
                    folder_of_case = write_case(data / "import", cameras, frames, folder)
                    match, found = run_in_process(
                        store, folder_of_case, options.until, options.iterations, {}
                    )
                except WorldposeError as error:
                    rows.append([label, type(error).__name__, *[None] * 6])
                    continue
                parts = [
                    part
                    for part in (
                        range(frames.start, min(frames.stop, options.shown)),
                        range(max(frames.start, options.shown), frames.stop),
                    )
                    if np.isfinite(
                        truth["gt"][np.isin(truth["frames"], part)][:, [0, 2], 0, 0]
                    ).any()
                ]
                for (turn, keys), part in itertools.product(enumerate(found, 1), parts):
                    own = score(scorer, truth, open_keys(store, match, keys), part)
                    said = f"{part.start} to {part.stop - 1}"
                    rows += [
                        [label, said, number, f"{letter}{turn}", *values]
                        for letter, values in own.items()
                    ]
                tell(format_rows(rows, label))
    return tabulate(rows)


def format_rows(rows: list[list[Any]], label: str) -> str:
    """Return the rows of a case in a line."""
    own = [f"{r[1]} {r[3]} {r[4]:.2f} {r[5]:.1f} {r[6]} {r[7]}" for r in rows if r[0] == label]
    return f"{label}: {'; '.join(own)}"


def tabulate(rows: list[list[Any]]) -> Tables:
    """Return all cases, and their means and worst by number of cameras."""
    scored = [row for row in rows if len(row) == 8 and row[4] is not None]
    summary = list[list[Any]]()
    for key in dict.fromkeys((row[2], row[1], row[3]) for row in scored):
        own = np.array([row[4:] for row in scored if (row[2], row[1], row[3]) == key])
        least, most = own.min(axis=0), own.max(axis=0)
        mean = np.nanmean(own, axis=0)
        summary.append([*key, mean[0], least[0], mean[1], most[1], int(own[:, 2].sum()), most[3]])
    values = ["PCP3D [%]", "error [mm]", "switches", "away [s]"]
    means = ["PCP3D [%]", "least", "error [mm]", "most", "switches", "away [s]"]
    return {
        "cases": Table("cases", ["case", "frames", "cameras", "joints", *values], rows),
        "means": Table("means and worst", ["cameras", "frames", "joints", *means], summary),
    }


def open_keys(store: Store, match: str, keys: dict[str, str]) -> Run:
    """Return results that no run has recorded as those of one."""
    fields: dict[str, Any] = {"failed": (), "blocked": (), "waiting": (), "body_folder": None}
    record = RunRecord.model_construct(run_id="0001", match_id=match, results=keys, **fields)
    return Run(store, record)


def score(scorer: Any, truth: Any, run: Run, frames: range) -> dict[str, tuple[float, ...]]:
    """Return PCP3D [%], mean error of matched people [mm], switches and `away` [s], by letter."""
    scores: dict[str, tuple[float, ...]] = {}
    for letter, stage, definition in SCORED:
        if stage is not None and f"{stage}/clip" not in run:
            continue
        tracks = joint_tracks(run, "clip", stage, definition)
        poses = dict(zip(tracks.frames.tolist(), tracks.joints, strict=True))
        found, _ = scorer.evaluate(truth["gt"], truth["frames"], poses, "shelf", frames=frames)
        error = found["mpjpe_mm_matched"]
        scores[letter] = (
            found["avg_pcp_actors_1_3"],
            np.nan if error is None else error,
            *follow_actors(scorer, truth, poses, frames),
        )
    return scores


def follow_actors(
    scorer: Any, truth: Any, poses: dict[int, Any], frames: range
) -> tuple[int, float]:
    """Return identity switches, and the longest time for which an actor has nobody [s]."""
    switches, longest = 0, 0
    for actor in (0, 2):
        seen, gone = list[int](), 0
        for row in np.flatnonzero(np.isin(truth["frames"], frames)):
            place = truth["gt"][row, actor]
            if not np.isfinite(place).all():
                continue
            pose = scorer.coco17_to_shelf14(poses.get(int(truth["frames"][row]), NOBODY), "shelf")
            away = scorer.pose_distance(place, pose)
            gone = gone + 1 if away.min(initial=np.inf) > AWAY_M else 0
            longest = max(longest, gone)
            if not gone:
                seen.append(int(away.argmin()))
        switches += sum(a != b for a, b in itertools.pairwise(seen))
    return switches, longest / FPS
