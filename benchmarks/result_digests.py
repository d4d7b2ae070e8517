"""Records digests of all result arrays of a fixed set of matches, and compares two records.

    python benchmarks/result_digests.py FILE [--data DATA] [--cases NAME ...] [--keep FOLDER]
    python benchmarks/result_digests.py FILE --compare OTHER

A change of structure must not change a number. The command line simulates and runs the matches, and
this script reads their stores with zarr alone. DATA holds `shelf_dev`, see `shelf.py`; without it
that case is omitted. For an array whose digest differs, the comparison has the number of missing
values, the mean and the standard deviation in both records, and exits with 1.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from common import run_worldpose
from registry import Table, Tables, benchmark, option

CASES: dict[str, tuple[list[str], list[str]]] = {
    "tiny": (["--scenario", "tiny", "--seed", "11", "--no-stills"], []),
    "match": (
        ["--scenario", "match", "--seed", "14", "--duration", "1", "--no-stills"],
        ["--iterations", "2"],
    ),
    "hard": (["--scenario", "hard", "--seed", "15", "--duration", "0.6", "--no-stills"], []),
    "penalty-box": (["--scenario", "penalty-box", "--seed", "13", "--duration", "1"], []),
    "tiny-broadcast": (["--scenario", "tiny-broadcast", "--seed", "12", "--no-stills"], []),
    "broadcast-pan": (["--scenario", "broadcast-pan", "--seed", "16", "--duration", "1"], []),
    "broadcast-zoom": (["--scenario", "broadcast-zoom", "--seed", "17", "--duration", "1"], []),
    "two-cameras": (
        ["--scenario", "tiny", "--seed", "18", "--cameras", "2", "--duration", "1", "--no-stills"],
        [],
    ),
    "rendered": (
        ["--scenario", "tiny", "--seed", "19", "--cameras", "3", "--duration", "0.4", "--render"],
        ["--set", "detection.stride=2"],
    ),
}
"""Options of `worldpose simulate` and `worldpose run`."""

SHELF = "shelf"


@benchmark(
    "result_digests",
    "digests of all result arrays of a fixed set of matches",
    option("file", type=Path, help="record to write, or to compare"),
    option("--compare", type=Path, metavar="OTHER"),
    option("--data", type=Path),
    option("--cases", nargs="+", choices=[*CASES, SHELF]),
    option("--keep", type=Path, metavar="FOLDER"),
)
def record_digests(options: Namespace) -> Tables:
    """See the head of benchmarks/result_digests.py, which is a command of its own."""
    rows: list[list[Any]] = []
    if options.compare is not None:
        ours, theirs = (json.loads(file.read_text()) for file in (options.file, options.compare))
        rows = compare(ours, theirs)
        return {"differences": Table("arrays that differ", ["array", "one", "other"], rows)}
    names = options.cases or [*CASES, *([SHELF] if options.data else [])]
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            begun = time.monotonic()
            found[name] = run_case(name, options.data, folder)
            rows.append([name, len(found[name]), time.monotonic() - begun])
    options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    return {"cases": Table("recorded", ["case", "arrays", "time [s]"], rows)}


def compare(ours: dict[str, Any], theirs: dict[str, Any]) -> list[list[Any]]:
    """Return the arrays that differ, and what is known of them."""
    rows: list[list[Any]] = []
    for case in sorted(ours.keys() | theirs.keys()):
        one, other = ours.get(case, {}), theirs.get(case, {})
        for name in sorted(one.keys() | other.keys()):
            pair = (one.get(name), other.get(name))
            if pair[0] is None or pair[1] is None or pair[0]["digest"] != pair[1]["digest"]:
                rows.append([f"{case} {name}", *pair])
    return rows


def run_case(name: str, data: Path | None, folder: Path) -> dict[str, Any]:
    """Simulate and run one match; return the arrays of its runs by `run/stage/unit/array`."""
    match, project = folder / name, folder / f"{name}-project"
    options: list[str] = []
    if name == SHELF:
        if data is None:
            raise ValueError("case shelf needs --data")
        given = data / "shelf_dev" / "import"
        calibration, detections = given / "calibration.toml", given / "detections"
        cameras = ["--calibration", str(calibration), "--detections", str(detections)]
        run_worldpose("import", *cameras, "--fps", "25", "--out", match)
    else:
        simulate, options = CASES[name]
        run_worldpose("simulate", *simulate, "--out", match)
    run_worldpose("run", match, *options, "--project", project, accepted=(0, 4))
    return digests_of_project(project)


def digests_of_project(project: Path) -> dict[str, Any]:
    """Return digest and moments of each array of each run."""
    found = {}
    for record in sorted(project.glob("runs/*/*.json")):
        run = json.loads(record.read_text())
        results = project / "results" / record.parent.name
        for unit, key in sorted(run["results"].items()):
            group = zarr.open_group(results / unit / key, mode="r")
            for name, array in sorted(group.arrays()):
                found[f"{record.stem}/{unit}/{name}"] = describe_array(np.asarray(array[...]))
    return found


def describe_array(values: np.ndarray) -> dict[str, Any]:
    """Return an array's digest, shape, missing values, mean and standard deviation."""
    digest = hashlib.sha256(f"{values.dtype.str}{values.shape}".encode())
    digest.update(values.tobytes() if values.dtype.kind != "O" else repr(values.tolist()).encode())
    told: dict[str, Any] = {"digest": digest.hexdigest()[:20], "shape": list(values.shape)}
    if values.dtype.kind in "fiub" and values.size:
        known = values[np.isfinite(values)].astype(float)
        told["missing"] = int(values.size - known.size)
        if known.size:
            told["mean"], told["std"] = float(known.mean()), float(known.std())
    return told


if __name__ == "__main__":
    from run import main

    tables = main(["result_digests", *sys.argv[1:]])
    sys.exit(1 if "differences" in tables and tables["differences"].rows else 0)
