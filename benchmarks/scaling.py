"""Prints how the time of stages falls with the number of workers on slow machines.

    python benchmarks/scaling.py MATCH_FOLDER [--workers 1 2 4] [--share 0.25] [--reports FOLDER]

Each worker is a Dask worker process that Linux gives `--share` of one processor (control group
`cpu`, version 1 or 2; needs its permission), as a machine of that speed would be, so that four
workers fit on two processors. For each number of workers the match runs in a new project on a Dask
scheduler of its own; the command itself and Prefect's server are not slowed down. Efficiency is the
time with one worker over the number of workers times the time with them. The serial part is that of
Amdahl's law for the largest number: it contains units that are left for one worker at the end.
`--reports` saves Dask's dashboard of each run as a page; that needs the package bokeh.

    worldpose simulate --scenario tiny --seed 1 --duration 0.32 --cameras 8 --render --out tiny-8
    python benchmarks/scaling.py tiny-8
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from common import WORLDPOSE
from distributed import Client, performance_report
from run_memory import stage_spans

PERIOD_US = 20_000
"""Period in which a group gets its share [us]."""
GROUPS = Path("/sys/fs/cgroup")
DASK = Path(sys.executable).with_name("dask")


@contextmanager
def limited_group(name: str, share: float) -> Iterator[Path]:
    """Yield a new control group whose processes get `share` of one processor together."""
    is_v2 = (GROUPS / "cgroup.controllers").exists()
    group = (GROUPS if is_v2 else GROUPS / "cpu") / name
    group.mkdir()
    try:
        quota = int(share * PERIOD_US)
        if is_v2:
            (group / "cpu.max").write_text(f"{quota} {PERIOD_US}")
        else:
            (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
            (group / "cpu.cfs_quota_us").write_text(str(quota))
        yield group
    finally:
        for _ in range(100):  # ended processes leave it a little later
            try:
                group.rmdir()
                break
            except OSError:
                time.sleep(0.1)


@contextmanager
def process(command: list[str], log: Path, group: Path | None = None) -> Iterator[None]:
    """Run a command in a control group until the block ends."""
    with log.open("w") as out:
        started = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        try:
            if group is not None:
                (group / "cgroup.procs").write_text(str(started.pid))
            yield
        finally:
            started.terminate()
            started.wait()


def free_port() -> int:
    """Return a port of this machine that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_workers(folder: Path, count: int) -> None:
    """Return as soon as each worker says that it is registered."""
    for _ in range(1200):
        logs = [(folder / f"worker-{n}.log").read_text() for n in range(count)]
        if all("Registered to" in log for log in logs):
            return
        time.sleep(0.5)
    raise SystemExit(f"workers did not start: see {folder}")


def measure(
    match: Path, folder: Path, workers: int, share: float, reports: Path | None
) -> dict[str, float]:
    """Return the time of each stage up to detection with so many workers [s]."""
    address = f"tcp://127.0.0.1:{free_port()}"
    port = address.rpartition(":")[2]
    with ExitStack() as stack:
        scheduler = [str(DASK), "scheduler", "--host", "127.0.0.1", "--port", port]
        stack.enter_context(process([*scheduler, "--no-dashboard"], folder / "scheduler.log"))
        for n in range(workers):
            group = stack.enter_context(limited_group(f"scaling-{os.getpid()}-{n}", share))
            worker = [str(DASK), "worker", address, "--nthreads", "1", "--memory-limit", "0"]
            command = [*worker, "--no-dashboard", "--preload", "tasks.preload"]
            stack.enter_context(process(command, folder / f"worker-{n}.log", group))
        wait_for_workers(folder, workers)
        run = [str(WORLDPOSE), "run", str(match), "--project", str(folder / "project")]
        with (folder / "run.log").open("w") as log:
            if reports is not None:
                stack.enter_context(Client(address))
                page = reports / f"{workers}_workers.html"
                stack.enter_context(performance_report(filename=str(page), mode="inline"))
            command = [*run, "--dask", address, "--until", "detection"]
            code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode
        if code != 0:
            raise SystemExit(f"the run ended with {code}: see {folder / 'run.log'}")
    spans = stage_spans(folder / "project", match)
    return {stage: last - first for stage, (first, last) in spans.items()}


def main() -> None:
    """Print one line per stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("match", type=Path)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--share", type=float, default=0.25)
    parser.add_argument("--reports", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    if options.reports is not None:
        options.reports.mkdir(parents=True, exist_ok=True)
    found: dict[int, dict[str, float]] = {}
    folder = Path(tempfile.mkdtemp(prefix="scaling-"))
    for count in sorted({1, *options.workers}):
        part = folder / str(count)
        part.mkdir()
        found[count] = measure(options.match, part, count, options.share, options.reports)
        print(f"{count} workers: {sum(found[count].values()):.1f} s", flush=True)
    most = max(found)
    print("| stage | " + " | ".join(f"{n} workers" for n in found) + " | serial part |")
    print("| --- " * (len(found) + 2) + "|")
    for stage, alone in found[1].items():
        cells = []
        for count, times in found.items():
            cells.append(f"{times[stage]:.1f} s, {100 * alone / (count * times[stage]):.0f} %")
        serial = (found[most][stage] / alone - 1 / most) / (1 - 1 / most) if most > 1 else 1.0
        print(f"| {stage} | " + " | ".join(cells) + f" | {100 * serial:.0f} % |")


if __name__ == "__main__":
    main()
