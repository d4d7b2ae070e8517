"""Computes one unit of a project's latest run again, and prints its CPU time and its files.

    python benchmarks/unit_cost.py PROJECT MATCH_FOLDER STAGE/UNIT [--repeat 2] [--as-dask]

The unit is computed in a thread of this process, as a Dask worker does, from the inputs of that
run, in a copy of the project whose files are links. The first computation includes the loading of
kernels, and their compilation after a change of code. `--as-dask` leaves out `keep_freed_memory`;
start the process with MALLOC_TRIM_THRESHOLD_=65536 in its environment, as Dask starts workers.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from data_contracts.work import Work
from tasks.unit import keep_freed_memory
from worldpose.store import ResultId, Store

PAGE = 256
"""Frames per read, as in `tasks.clip_inputs`."""


def measure_cpu(compute: Callable[[], object]) -> float:
    """Return the user and system time of a call in a thread of its own [s]."""
    failures: list[BaseException] = []

    def run() -> None:
        try:
            compute()
        except BaseException as failure:  # reported by the main thread
            failures.append(failure)

    before = os.times()
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if failures:
        raise failures[0]
    after = os.times()
    return after.user + after.system - before.user - before.system


def read_pages(store: Store, result: ResultId) -> None:
    """Read all arrays of a result with a dimension of frames, some frames at a time."""
    data = store.open_result(result.match_id, result.stage, result.unit, result.key)
    names = [name for name, array in data.data_vars.items() if array.dims[:1] == ("frame",)]
    for first in range(0, data.sizes["frame"] if names else 0, PAGE):
        for name in names:
            _ = data[name][first : first + PAGE].values


def main() -> None:
    """Compute the unit, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=Path)
    parser.add_argument("match", type=Path)
    parser.add_argument("unit")
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--as-dask", action="store_true")
    options = parser.parse_args()
    if not options.as_dask:
        keep_freed_memory()
    given = Store.open(options.project)
    (match_id,) = given.matches()
    stage, _, unit = options.unit.partition("/")
    result = ResultId(match_id, stage, unit, given.run(match_id).results[options.unit])
    manifest = given.manifest(match_id, stage, unit, result.key)
    task = getattr(importlib.import_module(f"tasks.{stage}"), stage)
    with tempfile.TemporaryDirectory(dir=options.project.parent) as scratch:
        copy = Path(scratch) / "project"
        shutil.copytree(options.project, copy, copy_function=os.link)
        store = Store.open(copy)
        work = Work(
            project=str(copy),
            folder=str(options.match.resolve()),
            recipe=manifest.recipe,
            key=manifest.key,
            run_id="0001",
        )
        for _ in range(options.repeat):
            store.withdraw(result)
            # Below the wrapper, which refuses code other than the run's.
            cpu = measure_cpu(lambda: task.fn.__wrapped__(work))
            print(f"{options.unit}: {cpu:.2f} s of CPU")
        folder = copy / result.path
        files = [path for path in folder.rglob("*") if path.is_file()]
        place = (match_id, stage, unit, result.key)
        verify = measure_cpu(lambda: store.open_result(*place, verify=True))
        pages = measure_cpu(lambda: read_pages(store, result))
        size = sum(path.stat().st_size for path in files)
        print(
            f"{len(files)} files, {size / 1e6:.1f} MB; verify {verify:.2f} s, "
            f"read by {PAGE} frames {pages:.2f} s of CPU"
        )


if __name__ == "__main__":
    main()
