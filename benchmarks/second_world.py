"""Every stage of whole runs on matches of the second simulator, scored against the truth."""

from __future__ import annotations

import io
import json
import multiprocessing
import shutil
import signal
import sys
import tempfile
import time
import traceback
from argparse import Namespace
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from common import load_module, tell
from joint_regions import group_errors, region_counts
from registry import DATA, Table, Tables, benchmark, duration, integer, option
from shelf import ALL_FRAMES, SCORED, list_cameras, write_case

from data_contracts.arrays import Integers
from data_contracts.conventions import JOINT_GROUPS
from data_contracts.run import RunRecord
from flows.match import task_of
from flows.registering import find_match
from flows.results.best_results import joint_tracks
from flows.review.advice import clock_advice
from flows.run_plan import PlannedUnit
from flows.run_record import RunLog
from flows.settings import selected_stages
from flows.stage import Stage
from worldpose.evaluation.matching import joint_distances, match_people
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks, read_joints
from worldpose.ingest.footage import unit_frames
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.foreign.matches import simulate_foreign_match
from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
from worldpose.simulation.matches import simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.settings import MatchOptions
from worldpose.store.store import Run, Store, open_run

MIX = (
    *("foreign-match", "foreign-lab", "foreign-mixed", "foreign-two", "foreign-match"),
    *("foreign-mixed", "foreign-lab", "foreign-match", "foreign-many", "foreign-mixed"),
)
"""Scenarios of ten matches in a row."""

STAGES = ("triangulation", "retriangulation", "body_fitting")

GATE = 1.0
"""Maximum mean joint distance between a true person and a result [m]."""

SCORES = ("mpjpe_mm", "g_mpjpe_mm", "pa_mpjpe_mm", "coverage", "idf1", "switches")


@benchmark(
    "second_world",
    "every stage of whole runs on matches of the second simulator, or of the first",
    integer("matches", 40, "of the mix, or of each scenario"),
    option("--scenarios", nargs="+", choices=[*SCENARIOS, *FOREIGN_SCENARIOS]),
    duration(4.0),
    integer("seed", 1, "of the first match"),
    integer("iterations", 1),
    option("--recordings", type=Path, help="folder that every second match replays"),
    option("--calibrated", action="store_true", help="exact cameras"),
    option("--limit", type=float, default=3600.0, help="for one match [s]"),
    option("--resume", type=Path, default=Path("second_world"), metavar="DIR"),
    option("--keep", action="store_true", help="keep match folders and projects"),
    option("--report", action="store_true", help="only show what DIR holds"),
)
def score_matches(options: Namespace) -> Tables:
    """Every match is simulated, run with default settings and scored in a separate process.

    Stages are called in the flow's order, without Prefect or Dask. A match's row goes to
    DIR/rows.jsonl, and existing rows are not recomputed. Seen: people in the detections of two
    cameras or more in at least half of the frames. With a body: those of them with a body in at
    least half of these frames, within 1 m. Of joints seen by two cameras: mean error by joint
    group, and the share whose true place is in the stated 95 % region. Regions by the body model's
    definition are compared with the true joints, those by the detector's definition ("as detected")
    with what the detector takes for joints.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))  # also ends the match's process
    options.resume.mkdir(parents=True, exist_ok=True)
    file = options.resume / "rows.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    asked = [] if options.report else plans(options)
    for plan in asked:
        if any(plan.items() <= row.items() for row in rows):
            tell(f"{plan['scenario']} {plan['seed']}: as in {file}, not computed again")
            continue
        keep = options.resume / f"{plan['scenario']}-{plan['seed']}" if options.keep else None
        row = measure_apart(plan, options.limit, keep)
        rows.append(row)
        with file.open("a") as out:
            out.write(json.dumps(row) + "\n")
        tell(" ".join(map(str, list_match(row))))
    shown = [row for row in rows if not asked or any(p.items() <= row.items() for p in asked)]
    return report(shown)


@benchmark(
    "joint_regions",
    "true joints and labels inside stated regions: Shelf, the second simulator and the first",
    DATA,
    integer("matches", 2, "of each source"),
    duration(1.0),
    integer("seed", 1, "of the first match of each source"),
    option("--resume", type=Path, default=Path("joint_regions"), metavar="DIR"),
)
def score_regions(options: Namespace) -> Tables:
    """DATA holds `shelf_dev`; matches are measured as by `second_world`, in DIR.

    Share of joints in the stated regions of 95 % and of 50 %. Joints are those of `retriangulation`
    and, in simulation, compared with what the detector takes for joints; bodies by the body model's
    definition are compared with the true joints. Labels of Shelf count less a constant offset of
    each joint, and as they are. Regions were chosen on its frames 300 to 420.
    """
    fixed = {"iterations": 1, "calibrated": False, "recordings": None, "limit": 3600.0}
    shared = vars(options) | fixed | {"keep": False, "report": False}
    rows: list[list[Any]] = score_labels(options.data / "shelf_dev")
    for scenarios in (None, *(["penalty-box"], ["match"], ["hard"])):
        score_matches(Namespace(**shared, scenarios=scenarios))
        asked = plans(Namespace(**shared, scenarios=scenarios))
        every = map(json.loads, (options.resume / "rows.jsonl").read_text().splitlines())
        some = [
            row["stages"][0]
            for row in every
            if row.get("stages") and any(plan.items() <= row.items() for plan in asked)
        ]
        name = scenarios[0] if scenarios else "second world"
        for stage, result, key in (
            ("retriangulation", "joints", "regions_defined"),
            ("body_fitting", "bodies", "regions"),
            ("body_fitting", "bodies as detected", "regions_defined"),
        ):
            scored = [one[stage] for one in some if stage in one]
            for level, end in (("95 %", ""), ("50 %", "_50")) if scored else ():
                rows.append([f"{name}, {result}", level, *_ratios(scored, key + end)])
    columns = ["of", "region", *JOINT_GROUPS, "all"]
    return {"regions": Table("joints in stated regions", columns, rows, "%")}


def score_labels(data: Path) -> list[list[Any]]:
    """Return rows of the table of `score_regions` for Shelf."""
    truth, rows = np.load(data / "gt.npz"), []
    labels = np.full((*truth["gt"].shape[:2], 17, 3), np.nan)
    places = load_module(data / "pcp.py").COCO_FOR_SHELF
    labels[:, :, places] = truth["gt"][:, :, : len(places)]
    with tempfile.TemporaryDirectory() as temporary:
        folder, project = Path(temporary), Path(temporary) / "project"
        match = write_case(data / "import", list_cameras(data), ALL_FRAMES, folder)
        run_in_process(project, match, 1)
        run = open_run(str(project), match.name)
        for (first, last), (stage, definition), less in product(
            ((300, 420), (421, 510)), [scored[1:] for scored in SCORED[1:4]], (True, False)
        ):
            there = (truth["frames"] >= first) & (truth["frames"] <= last)
            known = JointTracks(truth["frames"][there], np.arange(4), labels[there])
            tracks = joint_tracks(run, "clip", stage, definition)
            name = "joints" if stage == "retriangulation" else f"bodies by the {definition}"
            title = f"Shelf {first} to {last}, {name}{', less offset' if less else ''}"
            for level in (0.95, 0.5):
                counts = region_counts(tracks, known, level, less_offset=less)
                values = _ratios([{"regions": counts}], "regions")
                rows.append([title, f"{100 * level:.0f} %", *values])
    return rows


def list_match(row: dict[str, Any]) -> list[Any]:
    """Return a match's row of the table."""
    said = [each.strip().splitlines()[-1][:200] for each in row.get("failures", [])]
    said += [f"warning: {each[:200]}" for each in row.get("warnings", [])]
    numbers = [row.get(name) for name in ("cameras", "people", "seen", "with_bodies")]
    return [f"{row['scenario']} {row['seed']}", row["state"], *numbers, "; ".join(said)]


def report(rows: list[dict[str, Any]]) -> Tables:
    """Return outcomes of matches, and errors and regions by scenario, stage and iteration."""
    columns = ["match", "state", "cameras", "people", "seen", "with a body", "said"]
    enough = [
        row
        for row in rows
        if row["state"] == "complete" and row["with_bodies"] >= 0.95 * row["seen"]
    ]
    title = f"{len(enough)} of {len(rows)} matches complete, with 95 % of the bodies"
    names = list(dict.fromkeys(row["scenario"] for row in rows))
    foreign = [name for name in names if name in FOREIGN_SCENARIOS]
    groups = {name: [name] for name in names} | ({"second world": foreign} if foreign else {})
    errors = ["MPJPE [mm]", "G-MPJPE [mm]", "PA-MPJPE [mm]", "coverage", "IDF1", "switches"]
    of_groups = [*JOINT_GROUPS, "all"]
    tables = {
        "errors": Table("errors, means over matches", [], []),
        "groups": Table("mean error", of_groups, [], "mm"),
        "groups_defined": Table("mean error, as detected", of_groups, [], "mm"),
        "regions": Table("joints in 95 % regions", of_groups, [], "%"),
        "regions_defined": Table("joints in 95 % regions, as detected", of_groups, [], "%"),
    }
    values: dict[str, list[list[Any]]] = {key: [] for key in tables}
    for name, members in groups.items():
        some = [row["stages"] for row in rows if row["scenario"] in members and "stages" in row]
        for iteration, stage in product(range(max(map(len, some), default=0)), STAGES):
            scored = [
                passes[iteration][stage]
                for passes in some
                if len(passes) > iteration and stage in passes[iteration]
            ]
            if scored:
                first = [f"{name}, {stage}, iteration {iteration + 1}", len(scored)]
                for key, numbers in summarize(scored).items():
                    values[key].append([*first, *numbers])
    shown = {
        key: replace(table, columns=["of", "matches", *(table.columns or errors)], rows=values[key])
        for key, table in tables.items()
    }
    return {"matches": Table(title, columns, [list_match(row) for row in rows]), **shown}


def summarize(scored: list[dict[str, Any]]) -> dict[str, list[float]]:
    """Return the values of some matches' rows, by table."""
    means = [
        float(np.mean([one[name] for one in scored if one[name] is not None] or [np.nan]))
        for name in SCORES
    ]
    means[-1] *= len(scored)
    return {
        "errors": means,
        "groups": _ratios(scored, "errors_mm"),
        "groups_defined": _ratios(scored, "errors_defined_mm"),
        "regions": _ratios(scored, "regions"),
        "regions_defined": _ratios(scored, "regions_defined"),
    }


def _ratios(scored: list[dict[str, Any]], name: str) -> list[float]:
    """Return the ratio of both numbers of each joint group, summed over matches, and of all."""
    sums = np.array([[one[name][group] for group in JOINT_GROUPS] for one in scored]).sum(axis=0)
    sums = np.append(sums, [sums.sum(axis=0)], axis=0)
    ratios = np.divide(sums[:, 0], sums[:, 1], out=np.full(len(sums), np.nan), where=sums[:, 1] > 0)
    found: list[float] = (100.0 * ratios if name.startswith("regions") else ratios).tolist()
    return found


def plans(options: Namespace) -> list[dict[str, Any]]:
    """Return the measurements to make."""
    if options.scenarios:
        numbers = [(s, options.seed + k) for s in options.scenarios for k in range(options.matches)]
    else:
        numbers = [(MIX[k % len(MIX)], options.seed + k) for k in range(options.matches)]
    recordings = None if options.recordings is None else str(options.recordings)
    return [
        {
            "scenario": name,
            "seed": seed,
            "duration": options.duration,
            "iterations": options.iterations,
            "calibrated": options.calibrated,
            "recordings": recordings if k % 2 and name in FOREIGN_SCENARIOS else None,
        }
        for k, (name, seed) in enumerate(numbers)
    ]


def run_in_process(project: Path, folder: Path, iteration: int) -> RunRecord:
    """Run one pass over the stages in this process; after a failed unit, others continue."""
    store = Store.open_or_new(str(project))
    match = find_match(store, str(folder))
    stages = selected_stages(None, None)
    log = RunLog.begin(store, match, stages, {}, "never", iteration)

    def compute(
        stage: Stage, units: list[PlannedUnit]
    ) -> Iterator[tuple[PlannedUnit, Exception | None]]:
        for unit in (each for each in units if not each.published):
            try:
                task_of(stage).fn(unit.work(store.url, match, log.run_id))
            except Exception as failure:  # the run continues, as on workers
                yield unit, failure
            else:
                yield unit, None

    return log.run_stages(compute)


def views_of_detections(folder: Path, truth: JointTracks) -> Integers:
    """Return the number of static cameras that detect each true person (frames, persons)."""
    count = np.zeros(truth.joints.shape[:2], np.int64)
    spec = read_match(folder).spec
    for camera in spec.static_cameras:
        known = np.load(folder / "reference" / "identities" / f"{camera.id}.npz")
        rows = known["frame"] - unit_frames(spec, camera.id).number(0) - truth.frames[0]
        for row, people in zip(rows, known["person"], strict=True):
            count[row, np.unique(people[people >= 0])] += 1
    return count


def score_stage(run: Run, stage: str, reference: Path, fps: float) -> dict[str, Any]:
    """Return the scores of one stage's joints, in all and by joint group."""
    tracks, truth = joint_tracks(run, "clip", stage), read_joints(reference / "joints.npz")
    scores, _ = evaluate_joints(tracks, truth, fps=fps)
    found: dict[str, Any] = {name: getattr(scores, name) for name in SCORES}
    seen = joint_tracks(run, "clip", stage, "detector")
    defined = read_joints(reference / "defined_joints.npz")
    return found | {
        "regions": region_counts(tracks, truth),
        "regions_50": region_counts(tracks, truth, 0.5),
        "regions_defined": region_counts(seen, defined),
        "regions_defined_50": region_counts(seen, defined, 0.5),
        "errors_mm": group_errors(tracks, truth),
        "errors_defined_mm": group_errors(seen, defined),
    }


def people_with_bodies(
    tracks: JointTracks | None, truth: JointTracks, shown: Integers
) -> dict[str, int]:
    """Return the number of people that two cameras see, and the number of those with bodies."""
    seen = shown >= 2
    people = np.flatnonzero(seen.mean(axis=0) >= 0.5)
    if tracks is None:
        return {"seen": len(people), "with_bodies": 0}
    places = {int(frame): row for row, frame in enumerate(tracks.frames)}
    rows = np.array([places.get(int(frame), -1) for frame in truth.frames])
    bodies = np.where((rows >= 0)[:, None, None, None], tracks.joints[rows], np.nan)
    there = match_people(joint_distances(bodies, truth.joints), GATE) >= 0
    share = (there & seen).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return {"seen": len(people), "with_bodies": int((share[people] >= 0.5).sum())}


def measure(plan: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Simulate, run and score one match; return its row."""
    name, seed = plan["scenario"], plan["seed"]
    out, project = folder / "match", folder / "project"
    row = dict(plan)
    begun = time.monotonic()
    options = MatchOptions(duration=plan["duration"], video=False, calibrated=plan["calibrated"])
    if name in FOREIGN_SCENARIOS:
        recordings = None if plan["recordings"] is None else Path(plan["recordings"])
        simulate_foreign_match(FOREIGN_SCENARIOS[name], seed, out, options, recordings)
        record = json.loads((out / "reference" / "world.json").read_text())
        row |= {key: record[key] for key in ("layout", "pitch", "calibration")}
        row["detector"] = record["detector"]["name"]
    else:
        simulate_match(SCENARIOS[name], seed, out, options)
    row["simulated_s"] = round(time.monotonic() - begun, 1)
    spec = read_match(out).spec
    truth = read_joints(out / "reference" / "joints.npz")
    row |= {"fps": spec.fps, "cameras": len(spec.static_cameras), "people": truth.joints.shape[1]}
    runs: list[RunRecord] = []
    for iteration in range(1, plan["iterations"] + 1):
        runs.append(run_in_process(project, out, iteration))
        if runs[-1].state != "complete":
            break
    last = runs[-1]
    row |= {
        "state": last.state,
        "failures": [f"{one.unit}: {one.error}: {one.message}" for one in last.failed],
        "left_out": last.left_out,
        "warnings": [*last.warnings, *clock_advice(last.figures, spec)],
        "run_s": round(sum(run.seconds for run in runs), 1),
        "stages": [],
    }
    bodies = None
    for record in runs:
        run, scored = open_run(str(project), spec.match_id, record.run_id), {}
        for stage in STAGES:
            if f"{stage}/clip" in run:
                scored[stage] = score_stage(run, stage, out / "reference", spec.fps)
                if stage == "body_fitting":
                    bodies = joint_tracks(run, "clip", stage)
        row["stages"].append(scored)
    return row | people_with_bodies(bodies, truth, views_of_detections(out, truth))


def measure_apart(plan: dict[str, Any], limit: float, keep: Path | None) -> dict[str, Any]:
    """Return one match's row, measured in a process that may crash or hang."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if keep is None else keep
        if keep is not None:
            shutil.rmtree(keep, ignore_errors=True)
            keep.mkdir(parents=True)
        answer = folder / "row.json"

        def work() -> None:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the process ends with its parent
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                try:
                    row = measure(plan, folder)
                except Exception:  # a bug of ours or of the benchmark: the row shows it
                    row = plan | {"state": "traceback", "failures": [traceback.format_exc()]}
            answer.write_text(json.dumps(row))

        process = multiprocessing.get_context("fork").Process(target=work, daemon=True)
        process.start()
        process.join(limit)
        if process.is_alive():
            process.kill()
            process.join()
            return plan | {"state": "hang", "failures": [f"stopped after {limit:g} s"]}
        if not answer.exists():
            return plan | {"state": "crash", "failures": [f"exit code {process.exitcode}"]}
        return dict(json.loads(answer.read_text()))
