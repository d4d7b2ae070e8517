"""Prints time and peak memory of each stage of whole runs, and their growth with the duration.

    python benchmarks/run_memory.py MATCH_FOLDER [MATCH_FOLDER ...] [--to 5400] [--keep FOLDER]

Every match runs as `worldpose run` in a new project, and the resident memory of all its processes
is read from /proc four times per second. A stage's peak is that of the largest process while the
stage's units are computed, and `all` is the largest sum over all processes. With several matches,
which should differ in duration alone, the last columns extrapolate a straight line through the
shortest and the longest match to `--to` seconds.

    worldpose simulate --scenario match --seed 1 --duration 60 --no-stills --no-video --out m60
    worldpose simulate --scenario match --seed 1 --duration 600 --no-stills --no-video --out m600
    python benchmarks/run_memory.py m60 m600
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

from common import WORLDPOSE

from worldpose.ingest.match_folder import read_match
from worldpose.store.store import Store

INTERVAL_S = 0.25
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Memory:
    """Resident memory over time: moment [s since the epoch], largest process and sum [byte]."""

    samples: list[tuple[float, int, int]] = field(default_factory=list)

    def follow(self, root: int, ended: threading.Event) -> None:
        """Sample the processes that descend from `root` until `ended`."""
        while not ended.wait(INTERVAL_S):
            sizes = [resident_bytes(pid) for pid in descendants(root)]
            if sizes:
                self.samples.append((time.time(), max(sizes), sum(sizes)))

    def peak(self, begin: float, end: float) -> tuple[int, int]:
        """Return the largest process and the largest sum between two moments."""
        inside = [each for each in self.samples if begin <= each[0] <= end + INTERVAL_S]
        return (
            max((largest for _, largest, _ in inside), default=0),
            max((total for _, _, total in inside), default=0),
        )


def descendants(root: int) -> list[int]:
    """Return a process and all that descend from it."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                said = (entry / "stat").read_text()
            except OSError:  # ended meanwhile
                continue
            parents[int(entry.name)] = int(said.rpartition(")")[2].split()[1])
    family = {root}
    while new := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= new
    return sorted(family & parents.keys())


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process [byte]; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE_BYTES
    except OSError:
        return 0


@dataclass(frozen=True)
class Cost:
    """Cost of a stage or of the whole run.

    Attributes:
        seconds: from the start of its first unit to the end of its last [s].
        largest: peak of the largest process [byte].
        total: peak of all processes together [byte].
    """

    seconds: float
    largest: int
    total: int


def stage_spans(project: Path, folder: Path) -> dict[str, tuple[float, float]]:
    """Return start of the first and end of the last unit of each stage of the latest run [s]."""
    store = Store.open(str(project))
    record = store.run(read_match(folder).spec.match_id, "latest")
    spans: dict[str, tuple[float, float]] = {}
    for name in record.executed:
        stage, _, unit = name.partition("/")
        manifest = store.manifest(record.match_id, stage, unit, record.results[name])
        last = manifest.created_at.timestamp()
        first = (manifest.created_at - timedelta(seconds=manifest.seconds)).timestamp()
        known = spans.get(stage, (first, last))
        spans[stage] = min(first, known[0]), max(last, known[1])
    return spans


def measure(folder: Path, project: Path) -> dict[str, Cost]:
    """Run a match in a new project and return the cost of its stages and of `all`."""
    command = [str(WORLDPOSE), "run", str(folder), "--project", str(project)]
    begin = time.time()
    with (project.parent / f"{project.name}.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        memory, ended = Memory(), threading.Event()
        watcher = threading.Thread(target=memory.follow, args=(process.pid, ended))
        watcher.start()
        code = process.wait()
        ended.set()
        watcher.join()
    whole = time.time() - begin
    if code != 0:
        raise SystemExit(f"{' '.join(command)} ended with {code}: see {log.name}")
    spans = stage_spans(project, folder)
    costs = {
        stage: Cost(last - first, *memory.peak(first, last))
        for stage, (first, last) in sorted(spans.items(), key=lambda item: item[1])
    }
    return {**costs, "all": Cost(whole, *memory.peak(begin, begin + whole))}


def main() -> None:
    """Print one line per stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("matches", type=Path, nargs="+")
    parser.add_argument("--to", type=float, default=5400.0, help="duration to extrapolate to [s]")
    parser.add_argument("--keep", type=Path, help="folder for the projects")
    options = parser.parse_args()
    runs: list[tuple[float, dict[str, Cost]]] = []
    with tempfile.TemporaryDirectory() as temporary:
        parent = options.keep or Path(temporary)
        parent.mkdir(parents=True, exist_ok=True)
        for folder in options.matches:
            spec = read_match(folder).spec
            duration = sum(clip.frame_count for clip in spec.clips) / spec.fps
            print(f"{folder.name}: {duration:g} s of match", flush=True)
            runs.append((duration, measure(folder, parent / folder.name)))
    runs.sort(key=lambda run: run[0])
    title = "| stage | " + " | ".join(f"{duration:g} s: time, peak" for duration, _ in runs)
    print(title + (f" | {options.to:g} s |" if len(runs) > 1 else " |"))
    print("| --- " * (1 + len(runs) + (len(runs) > 1)) + "|")
    for stage in runs[-1][1]:
        cells = []
        for _, costs in runs:
            cost = costs.get(stage, Cost(0.0, 0, 0))
            peak = cost.total if stage == "all" else cost.largest
            cells.append((cost.seconds, peak / 1e6))
        row = [f"{seconds:.1f} s, {megabytes:.0f} MB" for seconds, megabytes in cells]
        if len(runs) > 1:
            share = (options.to - runs[0][0]) / (runs[-1][0] - runs[0][0])
            ahead = [
                first + share * (last - first)
                for first, last in zip(cells[0], cells[-1], strict=True)
            ]
            row.append(f"{ahead[0]:.0f} s, {ahead[1]:.0f} MB")
        print(f"| {stage} | " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
