"""Records digests of all result arrays of a fixed set of matches, and compares two records.

    python benchmarks/result_digests.py FILE [--data DATA] [--cases NAME ...] [--keep FOLDER]
    python benchmarks/result_digests.py FILE --compare OTHER

A change of structure must not change a number. The command line simulates and runs the matches, and
this script reads their stores with zarr alone, so that it needs no name of the code that changes.
DATA holds `shelf_dev`, see `shelf.py`; without it that case is omitted. For an array whose digest
differs, the comparison prints the number of missing values, the mean and the standard deviation in
both records.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import zarr

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
        worldpose(["import", *cameras, "--fps", "25", "--out", str(match)])
    else:
        simulate, options = CASES[name]
        worldpose(["simulate", *simulate, "--out", str(match)])
    worldpose(["run", str(match), *options, "--project", str(project)], accepted=(0, 4))
    return digests_of_project(project)


def worldpose(arguments: list[str], accepted: tuple[int, ...] = (0,)) -> None:
    """Run the command line; exit with its output if its exit code is not accepted."""
    ended = subprocess.run(
        [Path(sys.executable).parent / "worldpose", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if ended.returncode not in accepted:
        sys.exit(f"worldpose {' '.join(arguments)}: exit code {ended.returncode}\n{ended.stderr}")


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


def compare(ours: dict[str, Any], theirs: dict[str, Any]) -> int:
    """Print the arrays that differ; return their number."""
    count = 0
    for case in sorted(ours.keys() & theirs.keys()):
        one, other = ours[case], theirs[case]
        for name in sorted(one.keys() | other.keys()):
            if name in one and name in other and one[name]["digest"] == other[name]["digest"]:
                continue
            count += 1
            print(f"{case} {name}\n  {one.get(name, 'absent')}\n  {other.get(name, 'absent')}")
        print(f"{case}: {len(one)} and {len(other)} arrays compared")
    for case in sorted(ours.keys() ^ theirs.keys()):
        count += 1
        print(f"{case}: only in one record")
    return count


def main() -> None:
    """Record the cases, or compare two records."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--compare", type=Path, metavar="OTHER")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--cases", nargs="+", choices=[*CASES, SHELF])
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    if options.compare is not None:
        records = (json.loads(file.read_text()) for file in (options.file, options.compare))
        sys.exit(1 if compare(*records) else 0)
    names = options.cases or [*CASES, *([SHELF] if options.data else [])]
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            begun = time.monotonic()
            found[name] = run_case(name, options.data, folder)
            print(f"{name}: {len(found[name])} arrays, {time.monotonic() - begun:.0f} s")
    options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
