"""Prints PCP3D of the Shelf sequence through whole runs: all cameras, one less, and causally.

    python benchmarks/shelf.py DATA

DATA holds `shelf_dev`: `import/` (calibration.toml, detections), `gt.npz` and `pcp.py`, the
sequence's own evaluator. Every line is an import and a run by the command line; scored are the
joints of `retriangulation` and the fitted bodies, in the definition of the body model and of the
detector, actors 1 and 3, alpha 0.5.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import shutil
import tempfile
from pathlib import Path
from types import ModuleType

import numpy as np
from common import run_worldpose

from worldpose.formats import read_joints


def load_scorer(folder: Path) -> ModuleType:
    """Return the sequence's evaluator."""
    spec = importlib.util.spec_from_file_location("pcp", folder / "pcp.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def main() -> None:
    """Print one line per run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data / "shelf_dev"
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
