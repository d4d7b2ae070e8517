"""Prints PCP3D of the Shelf sequence through whole runs: all cameras, one less, and causally.

    python benchmarks/shelf.py DATA
    python benchmarks/shelf.py DATA --groups [--set STAGE.SETTING=JSON ...]

DATA holds `shelf_dev`: `import/` (calibration.toml, detections), `gt.npz` and `pcp.py`, the
sequence's own evaluator. Every line is an import and a run by the command line; scored are the
joints of `retriangulation` and the fitted bodies, in the definition of the body model and of the
detector, actors 1 and 3, alpha 0.5.

With --groups, frames 300 to 420 and 421 to 510 are two matches of all cameras, whose stages run in
this process. For each stage and joint group: mean distance to the labels; the same less a constant
offset per joint in the body's frame, which is the mean over all people of the window; and the share
of labels in 95 % regions, as they are and less that offset. Before it, the distances of bodies and
triangulated joints to keypoints of held-out cameras. Labels have no joints of the face but a
bottom and a top of the head. Then lengths of limbs, medians over frames and sides, relative to the
labels', per person.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import shutil
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from common import print_held_out, run_in_process, run_worldpose
from joint_regions import group_joints
from scipy.special import chdtri

from data_contracts.arrays import Floats
from flows.results.best_results import JointDefinition, joint_tracks
from worldpose.body_fitting.objective import body_axes
from worldpose.formats.joints_file import read_joints
from worldpose.ingest.importing import import_match
from worldpose.store.store import Store

FPS = 25.0
WINDOWS = (range(300, 421), range(421, 511))
"""Frames in which settings are chosen, and in which they are scored."""


def load_scorer(folder: Path) -> ModuleType:
    """Return the sequence's evaluator."""
    spec = importlib.util.spec_from_file_location("pcp", folder / "pcp.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def read_settings(words: list[str]) -> dict[str, Any]:
    """Return settings by stage from STAGE.SETTING=JSON."""
    overrides: dict[str, Any] = {}
    for word in words:
        name, _, value = word.partition("=")
        stage, _, setting = name.partition(".")
        overrides.setdefault(stage, {})[setting] = json.loads(value)
    return overrides


def without(given: Path, camera: str, folder: Path) -> Path:
    """Return a copy of the import form without one camera."""
    out = folder / "import"
    shutil.copytree(given, out)
    (out / "detections" / f"{camera}.json").unlink()
    parts = re.split(r"(?m)^(?=\[)", (given / "calibration.toml").read_text())
    kept = [part for part in parts if f'name = "{camera}"' not in part]
    assert len(kept) == len(parts) - 1
    (out / "calibration.toml").write_text("".join(kept))
    return out


def scores(data: Path, given: Path, folder: Path, *settings: str) -> list[float]:
    """Return PCP3D of retriangulated joints and of bodies in both definitions [%]."""
    scorer, truth = load_scorer(data), np.load(data / "gt.npz")
    match, project = folder / "shelf", folder / "project"
    calibration, detections = given / "calibration.toml", given / "detections"
    run_worldpose(
        *("import", "--calibration", calibration, "--detections", detections),
        *("--fps", 25, "--out", match),
    )
    run_worldpose("run", match, "--project", project, *settings)
    values = []
    for stage, definition in (
        ("retriangulation", "detector"),
        ("body_fitting", "body"),
        ("body_fitting", "detector"),
    ):
        out = folder / stage / definition
        run_worldpose(
            *("export", "shelf", "--format", "joints", "--stage", stage),
            *("--definition", definition, "--out", out, "--project", project),
        )
        tracks = read_joints(out / "joints.npz")
        poses = dict(zip(tracks.frames.tolist(), tracks.joints, strict=True))
        score, _ = scorer.evaluate(truth["gt"], truth["frames"], poses, "shelf")
        values.append(float(score["avg_pcp_actors_1_3"]))
    return values


GROUPS = ("head", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
STAGES = ("triangulation", "retriangulation", "body_fitting")
SCORED: tuple[tuple[str, JointDefinition], ...] = (
    *((stage, "detector") for stage in STAGES[:2]),
    *((STAGES[2], definition) for definition in ("body", "detector")),
)
"""Stages, and the definition of their joints."""
LIMBS = {"upper arms": (7, 8, 9, 10), "forearms": (6, 7, 10, 11), "thighs": (1, 2, 3, 4)}
LIMBS |= {"shanks": (0, 1, 4, 5)}
"""Ends of the right limb and of the left one, in the order of the labels."""


def compare_groups(data: Path, folder: Path, overrides: dict[str, Any]) -> None:
    """Print distances, regions and lengths of limbs of both windows."""
    scorer, truth = load_scorer(data), np.load(data / "gt.npz")
    joints = {name: group_joints(name) for name in GROUPS[1:]}
    rows = {name: np.flatnonzero(np.isin(scorer.COCO_FOR_SHELF, joints[name])) for name in joints}
    rows["head"] = np.array([12, 13])
    store = Store.create(folder / "project")
    cameras = tuple(sorted(file.stem for file in (data / "import" / "detections").glob("*.json")))
    for frames in WINDOWS:
        case = write_case(data / "import", cameras, frames, folder)
        match, (keys,) = run_in_process(store, case, "body_fitting", 1, overrides)
        run: Any = {
            f"{stage}/clip": store.open_result(match, stage, "clip", keys[f"{stage}/clip"])
            for stage in ("tracking", *STAGES)
        }
        labels = truth["gt"][np.isin(truth["frames"], frames)]
        label = f"frames {frames.start} to {frames.stop - 1}"
        key = keys["body_fitting/clip"]
        print_held_out(label, store.manifest(match, "body_fitting", "clip", key).figures)
        print(f"{label}: {', '.join(GROUPS)}")
        for stage, definition in SCORED:
            tracks = joint_tracks(run, "clip", stage, definition)
            found, covariance = match_labels(scorer, labels, tracks.joints, tracks.covariance)
            error = found - labels
            axes = label_axes(scorer, labels)
            local = np.einsum("fpba,fpjb->fpja", axes, error)
            rest = local - np.nanmean(local, axis=(0, 1))
            turned = np.einsum("fpba,fpjbc,fpcd->fpjad", axes, covariance, axes)
            print(f"  {stage}, {definition}")
            for what, each in (("distance [mm]", error), ("less offset [mm]", rest)):
                away = 1e3 * np.linalg.norm(each, axis=-1)
                print(
                    f"    {what:18s}", *(f"{np.nanmean(away[..., rows[g]]):6.1f}" for g in GROUPS)
                )
            for what, each in (("in regions [%]", local), ("less offset [%]", rest)):
                known = np.isfinite(each[..., :12, 0])
                squared = np.einsum(
                    "fpja,fpjab,fpjb->fpj",
                    each[..., :12, :],
                    np.linalg.inv(turned),
                    each[..., :12, :],
                )
                inside = 100.0 * np.where(known, squared <= chdtri(3, 0.05), np.nan)
                shown = (f"{np.nanmean(inside[..., rows[g]]):6.1f}" for g in GROUPS[1:])
                print(f"    {what:18s}", " " * 6, *shown)
            print(f"    lengths [%]       {length_errors(found, labels)}", flush=True)


def match_labels(
    scorer: ModuleType, labels: Floats, joints: Floats, covariance: Floats | None
) -> tuple[Floats, Floats]:
    """Return the nearest person of each labelled one: joints of the labels, and covariances."""
    assert covariance is not None
    poses = scorer.coco17_to_shelf14(joints)
    found = np.full(labels.shape, np.nan)
    stated = np.full((*labels.shape[:2], 12, 3, 3), np.nan)
    for frame, person in np.argwhere(np.isfinite(labels).all(axis=(2, 3))):
        away = scorer.pose_distance(labels[frame, person], poses[frame])
        nearest = int(away.argmin())
        if away[nearest] < 0.5:
            found[frame, person] = poses[frame, nearest]
            stated[frame, person] = covariance[frame, nearest][scorer.COCO_FOR_SHELF]
    return found, stated


def label_axes(scorer: ModuleType, labels: Floats) -> Floats:
    """Return forward, left and up (frames, persons, 3, 3) of the labels."""
    places = np.full((*labels.shape[:2], 17, 3), np.nan)
    places[:, :, scorer.COCO_FOR_SHELF] = labels[:, :, :12]
    return body_axes(places)


def length_errors(found: Floats, labels: Floats) -> str:
    """Return the errors of limbs' median lengths relative to the labels', per person [%].

    Medians are over frames and both sides: the labels of both forearms of a person differ by 31 %.
    """
    parts = []
    people = np.isfinite(labels[..., 0, 0]).any(axis=0)
    for name, ends in LIMBS.items():
        ours, theirs = (
            np.nanmedian(
                np.linalg.norm(
                    each[:, people][..., ends[::2], :] - each[:, people][..., ends[1::2], :],
                    axis=-1,
                ),
                axis=(0, 2),
            )
            for each in (found, labels)
        )
        parts.append(f"{name} " + " ".join(f"{100.0 * (r - 1.0):+.1f}" for r in ours / theirs))
    return "; ".join(parts)


def main() -> None:
    """Print one line per run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--groups", action="store_true", help="distances by joint group")
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    options = parser.parse_args()
    data = options.data / "shelf_dev"
    if options.groups:
        with tempfile.TemporaryDirectory() as temporary:
            compare_groups(data, Path(temporary), read_settings(options.settings))
        return
    cameras = sorted(file.stem for file in (data / "import" / "detections").glob("*.json"))
    runs: dict[str, tuple[str | None, tuple[str, ...]]] = {
        "all cameras": (None, ()),
        "causal": (None, ("--set", "tracking.causal=true")),
        **{f"without {camera}": (camera, ()) for camera in cameras},
    }
    print("PCP3D: joints, bodies by the body model and by the detector [%]")
    for label, (left_out, settings) in runs.items():
        with tempfile.TemporaryDirectory() as temporary:
            folder, given = Path(temporary), data / "import"
            if left_out is not None:
                given = without(given, left_out, folder)
            values = scores(data, given, folder, *settings)
        print(f"{label:16s}", *(f"{value:6.2f}" for value in values), flush=True)


if __name__ == "__main__":
    main()
