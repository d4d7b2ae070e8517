"""Pose2Sim's demos, next to Pose2Sim's own triangulation."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from argparse import Namespace
from functools import partial
from pathlib import Path

import numpy as np
from common import run_worldpose
from registry import OUT, Table, Tables, benchmark, option

import worldpose
from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from flows.results.best_results import joint_tracks
from flows.results.run_cameras import static_cameras
from worldpose.formats.detection_files import read_openpose_folder
from worldpose.formats.keypoint_files import on_frames
from worldpose.geometry.cameras import Camera
from worldpose.ingest.match_folder import read_match

LIMBS = ((5, 7), (6, 8), (7, 9), (8, 10), (11, 13), (12, 14), (13, 15), (14, 16))
"""Upper arms, forearms, thighs and shanks in COCO-17."""

BODY = tuple(range(5, 17))
"""Joints that are scored: the face is blurred in the demo's videos."""

MIN_CONFIDENCE = 0.3
"""Least confidence of a scored 2D keypoint [1]; Pose2Sim's threshold."""

NEAR_PX = 150.0
"""Largest mean distance of a person's joints from the 2D poses of that person [px]."""

NAMES = {
    f"{long[0].upper()}{short}": f"{long}_{short.lower()}"
    for long in ("left", "right")
    for short in ("Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle")
}
"""Pose2Sim's names of joints to those of COCO-17."""

SCRIPT = """
import sys, tomllib
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from Pose2Sim import calibration, personAssociation, triangulation
config = tomllib.loads(Path("Config.toml").read_text())
if sys.argv[2] == "convert":
    calibration.calibrate_cams_all(config)
personAssociation.associate_all(config)
triangulation.triangulate_all(config)
"""
"""Pose2Sim's own functions, run in the folder of a trial."""


@benchmark(
    "pose2sim_demo",
    "triangulation of Pose2Sim's demos, next to Pose2Sim's own, from the same 2D poses",
    option("tool", type=Path, help="folder into which Pose2Sim was installed"),
    option("nets", type=Path, help="folder with MoveNet in ONNX"),
    option("--demo", action="append", choices=("SinglePerson", "MultiPerson")),
    OUT,
)
def compare_demos(options: Namespace) -> Tables:
    """`pip install --no-deps --target TOOL pose2sim==0.10.49 rtoml anytree lxml`.

    `python infra/real_demo/fetch.py NETS` gets the nets. The stage `detection` finds 2D poses in
    the demo's videos, which a copy of the demo has in OpenPose's JSON. `worldpose import` and `run`
    compute this copy; Pose2Sim associates and triangulates the same files with its own defaults,
    with the demo's calibration and with that of the imported match. There is no truth: distances to
    the 2D poses, missing joints, the spread of limb lengths, and distances of bodies and joints to
    keypoints of cameras that they do not use. Pose2Sim (BSD-3) is called, not copied.
    """
    tables: Tables = {}
    with tempfile.TemporaryDirectory() as temporary:
        work = (options.out or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        for name in options.demo or ("SinglePerson", "MultiPerson"):
            tables |= compare(options.tool.resolve(), options.nets.resolve(), name, work)
    return tables


def detect(demo: Path, nets: Path, work: Path) -> tuple[Path, str]:
    """Return the project and the match whose stage `detection` holds the demo's 2D poses."""
    match, project = work / f"{demo.name}-videos", work / "project"
    if not match.exists():
        run_worldpose("import", "--pose2sim", demo, "--out", match)
    run_worldpose(
        *("run", match, "--project", project, "--until", "detection"),
        *("--set", f"detection.detector=onnx:{nets / 'movenet-multipose.onnx'}"),
        *("--set", f"detection.pose=onnx:{nets / 'movenet-thunder.onnx'}"),
        *("--set", "detection.zooms=[]", "--set", "detection.high_score_threshold=0.25"),
    )
    return project, match.name


def write_trial(demo: Path, detected: tuple[Path, str], out: Path, *, several: bool) -> None:
    """Write a copy of the demo with the 2D poses in OpenPose's JSON, one file per frame."""
    shutil.copytree(demo, out, ignore=shutil.ignore_patterns("intrinsics", "extrinsics"))
    config = (out / "Config.toml").read_text()
    for given, wanted in (
        ("pose_model = 'Body_with_feet'", "pose_model = 'COCO_17'"),
        ("fill_large_gaps_with = 'last_value'", "fill_large_gaps_with = 'nan'"),
        ("multi_person = false", f"multi_person = {str(several).lower()}"),
        ("make_c3d = true", "make_c3d = false"),
    ):
        config = config.replace(given, wanted)
    (out / "Config.toml").write_text(config)
    run = worldpose.open_run(str(detected[0]), detected[1])
    for camera in sorted(file.stem for file in (demo / "videos").glob("*.mp4")):
        seen = run[f"detection/{camera}.clip"]
        points, confidence = seen["keypoints"].values, seen["confidence"].values
        folder = out / "pose" / f"{camera}_json"
        folder.mkdir(parents=True)
        for row, frame in enumerate(seen["frame"].values.tolist()):
            there = np.isfinite(points[row, ..., 0]).any(axis=-1)
            people = np.concatenate([points[row], confidence[row, ..., None]], axis=-1)[there]
            found = [
                {"person_id": [-1], "pose_keypoints_2d": np.nan_to_num(one).ravel().tolist()}
                for one in people.astype(float)
            ]
            file = folder / f"{camera}_{frame:06d}.json"
            file.write_text(json.dumps({"version": 1.3, "people": found}))


def run_pose2sim(tool: Path, trial: Path, *, convert: bool) -> list[Floats]:
    """Return the joints (frames, 17, 3) [m] of Pose2Sim's people, z up; NaN where missing."""
    for folder in ("pose-associated", "pose-3d"):
        shutil.rmtree(trial / folder, ignore_errors=True)
    subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tool), "convert" if convert else "given"],
        cwd=trial,
        check=True,
        capture_output=True,
        env={**os.environ, "MPLBACKEND": "Agg"},
    )
    return [read_trc(file) for file in sorted((trial / "pose-3d").glob("*.trc"))]


def read_trc(file: Path) -> Floats:
    """Return joints (frames, 17, 3) [m], z up, by the frame numbers of a TRC file."""
    lines = file.read_text().splitlines()
    names = [name for name in lines[3].split("\t")[2:] if name.strip()]
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    values = np.array([[float(v) if v.strip() else np.nan for v in row] for row in rows])
    joints = np.full((int(values[:, 0].max()) + 1, 17, 3), np.nan)
    for place, name in enumerate(names):
        if name in NAMES:
            # Pose2Sim writes y, z, x of the calibration's world.
            three = values[:, 2 + 3 * place : 5 + 3 * place][:, [2, 0, 1]]
            joints[values[:, 0].astype(int), COCO17.index(NAMES[name])] = three
    joints[(joints == 0.0).all(axis=-1)] = np.nan
    return joints


def score(joints: Floats, cameras: Camera, seen: Floats) -> tuple[float, ...]:
    """Return metrics of one person.

    `joints` (frames, 17, 3) [m]; `seen` (frames, cameras, people, 17, 3) are x, y [px] and
    confidence of the 2D poses.

    Returns:
        Median and 90th percentile of the distance to the person's 2D poses [px], missing joints
        [%], and the mean over limbs of the standard deviation of their length [mm].
    """
    frames = min(len(joints), len(seen))
    joints, seen = joints[:frames], seen[:frames]
    errors = []
    for c in range(seen.shape[1]):
        shown = cameras[c].project(joints.reshape(-1, 3)).reshape(frames, 1, 17, 2)
        off = np.linalg.norm(seen[:, c, ..., :2] - shown, axis=-1)
        off[~(seen[:, c, ..., 2] > MIN_CONFIDENCE)] = np.nan
        off = off[..., BODY]
        number = np.isfinite(off).sum(axis=-1)
        mean = np.where(number >= 4, np.nansum(off, axis=-1) / np.maximum(1, number), np.inf)
        best = mean.argmin(axis=1)
        rows = np.arange(frames)
        kept = mean[rows, best] < NEAR_PX
        errors.append(off[rows[kept], best[kept]].ravel())
    every = np.concatenate(errors)
    every = every[np.isfinite(every)]
    missing = ~np.isfinite(joints[:, BODY, 0])
    lengths = [np.linalg.norm(joints[:, a] - joints[:, b], axis=-1) for a, b in LIMBS]
    return (
        float(np.median(every)),
        float(np.quantile(every, 0.9)),
        100.0 * float(missing.mean()),
        1e3 * float(np.mean([np.nanstd(length) for length in lengths])),
    )


def distance(one: Floats, other: Floats) -> float:
    """Return the median distance of two people's joints [m]; infinite if never seen together."""
    frames = min(len(one), len(other))
    off = np.linalg.norm(one[:frames] - other[:frames], axis=-1)
    off = off[np.isfinite(off)]
    return float(np.median(off)) if len(off) else np.inf


def compare(tool: Path, nets: Path, name: str, work: Path) -> Tables:
    """Return the tables of one demo."""
    demo, several = tool / "Pose2Sim" / f"Demo_{name}", name == "MultiPerson"
    trial, match, project = work / name, work / f"{name}-match", work / "project"
    for folder in (trial, match):
        shutil.rmtree(folder, ignore_errors=True)
    write_trial(demo, detect(demo, nets, work), trial, several=several)
    run_worldpose("import", "--pose2sim", trial, "--out", match)
    run_worldpose("run", match, "--project", project)
    given = worldpose.read_cameras(match / "calibration.toml")
    poses = []
    for camera in given:
        folder = trial / "pose" / f"{camera}_json"
        found = on_frames(folder, read_openpose_folder(folder).people, [(0, 100)])
        poses.append(np.concatenate([found.keypoints, found.confidence[..., None]], axis=-1))
    most = max(each.shape[1] for each in poses)
    seen = np.full((100, len(poses), most, 17, 3), np.nan)
    for c, each in enumerate(poses):
        seen[: len(each), c, : each.shape[1]] = each
    asked = Camera.stack(list(given.values()))
    methods: dict[str, tuple[list[Floats], Camera]] = {
        "Pose2Sim, the demo's calibration": (run_pose2sim(tool, trial, convert=True), asked)
    }
    (trial / "calibration" / "Calib_qualisys.toml").unlink()
    shutil.copy(match / "calibration.toml", trial / "calibration" / "Calib_match.toml")
    methods["Pose2Sim, the match's calibration"] = (run_pose2sim(tool, trial, convert=False), asked)
    for stage, label in (
        ("triangulation", "worldpose, joints, the same cameras"),
        ("retriangulation", "worldpose, joints, adjusted cameras"),
        ("body_fitting", "worldpose, bodies, adjusted cameras"),
    ):
        run = worldpose.open_run(str(project), match.name)
        tracks = joint_tracks(run, "clip", stage, "detector")
        whole = np.full((100, len(tracks.person_ids), 17, 3), np.nan)
        whole[tracks.frames] = tracks.joints
        cameras = asked
        if stage != "triangulation":
            # A camera that contradicts the others is left out, and scored as given.
            best = static_cameras(run, read_match(match).spec)
            cameras = Camera.stack([best.get(name, given[name]) for name in given])
        methods[label] = (list(np.moveaxis(whole, 1, 0)), cameras)
    rows = []
    first = next(iter(methods.values()))[0]
    for label, (people, cameras) in methods.items():
        for number, other in enumerate(first):
            one = min(people, key=partial(distance, other))
            rows.append([f"{label}, {number} of {len(people)}", *score(one, cameras, seen)])
    record = worldpose.open_run(str(project), match.name).record
    said = [
        [f"{unit}, {name}", 1000.0 * value]
        for unit, each in record.figures.items()
        for name, value in each.items()
        if name.startswith(("held_out_fitted_m.", "held_out_triangulated_m."))
    ]
    columns = ["method, person", "distance [px]", "90 % [px]", "missing [%]", "limbs [mm]"]
    return {
        name: Table(f"{name}, to 2D poses", columns, rows),
        f"{name}_held_out": Table("from held-out cameras", ["of", "rms"], said, "mm"),
    }
