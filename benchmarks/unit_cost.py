"""Computes one unit of a project's latest run again, and prints its CPU time and its files.

    python benchmarks/unit_cost.py PROJECT MATCH_FOLDER STAGE/UNIT [--repeat 2] [--as-dask]

The unit is computed in a thread of this process, as a Dask worker does, from the inputs of that
run, in a copy of the project whose files are links. The first computation includes the loading of
kernels, and their compilation after a change of code. `--as-dask` leaves out `keep_freed_memory`;
start the process with MALLOC_TRIM_THRESHOLD_=65536 in its environment, as Dask starts workers.

The run's arrays are then published to new projects, in files of one chunk and in files of as many
chunks as the store puts together, in turns (`--rounds`), and read again. The table has the best
time of each. `--repeat 0` prints this table alone.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import xarray as xr

import data_contracts.arrays
from data_contracts.schemas import LAYOUTS
from data_contracts.work import Work
from tasks.unit import keep_freed_memory
from worldpose.store.paths import ResultId
from worldpose.store.store import Store

PAGE = 256
"""Frames per read, as in `tasks.clip_inputs`."""
LAYOUTS_OF_FILES = {"a file per chunk": 1, "as published": data_contracts.arrays.SHARD_CHUNKS}
"""Chunks of an array in one file."""


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


def read_pages(open_result: Callable[[], xr.Dataset], page: int | None) -> None:
    """Read all arrays of a result, `page` frames at a time or each at once."""
    data = open_result()
    for array in data.data_vars.values():
        if page is None or array.dims[:1] != ("frame",):
            _ = array.values
            continue
        for first in range(0, array.sizes["frame"], page):
            _ = array[first : first + page].values


def publish_again(store: Store, work: Work, data: xr.Dataset) -> None:
    """Publish arrays that are in memory as the result of `work`."""
    (layout,) = (each for each in LAYOUTS if each.stage == work.recipe.stage)
    labels = {name: data[name].values.tolist() for name in layout.attributes if name in data.coords}
    with store.publish(work) as result:
        result.write(
            layout,
            {array.name: data[array.name].values for array in layout.arrays if array.name in data},
            {array.name: data[array.name].values for array in layout.coordinates},
            {name: data.attrs[name] for name in layout.attributes if name in data.attrs} | labels,
        )


def print_files(data: xr.Dataset, work: Work, scratch: Path, rounds: int) -> None:
    """Publish and read a result in files of each kind, and print a table."""
    best: dict[tuple[str, str], float] = {}
    seen: dict[str, str] = {}
    place = (work.recipe.match_id, work.recipe.stage, work.recipe.unit, work.key)

    def clock(kind: str, step: str, act: Callable[[], object]) -> None:
        begin = time.perf_counter()
        cpu = measure_cpu(act)
        for name, spent in (f"{step} [s]", time.perf_counter() - begin), (f"{step}, CPU [s]", cpu):
            best[name, kind] = min(spent, best.get((name, kind), spent))

    for _ in range(rounds):
        for kind, chunks in LAYOUTS_OF_FILES.items():
            data_contracts.arrays.SHARD_CHUNKS = chunks
            project = scratch / "published"
            store = Store.create(project)
            opened = partial(store.open_result, *place)
            clock(kind, "publish", partial(publish_again, store, work, data))
            clock(kind, "verify", partial(opened, verify=True))
            clock(kind, "read whole", partial(read_pages, opened, None))
            clock(kind, f"read by {PAGE} frames", partial(read_pages, opened, PAGE))
            folder = project / ResultId(*place).path
            files = [path for path in folder.rglob("*") if path.is_file()]
            size = sum(path.stat().st_size for path in files)
            seen[kind] = f"{len(files)} files with manifest, {size / 1e6:.1f} MB"
            shutil.rmtree(project)
    for kind, text in seen.items():
        print(f"{kind}: {text}")
    print(f"{'':24}" + "".join(f"{kind:>20}" for kind in LAYOUTS_OF_FILES))
    for name in dict.fromkeys(name for name, _ in best):
        print(f"{name:24}" + "".join(f"{best[name, kind]:20.2f}" for kind in LAYOUTS_OF_FILES))


def main() -> None:
    """Compute the unit, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=Path)
    parser.add_argument("match", type=Path)
    parser.add_argument("unit")
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
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
        if options.rounds:
            data = given.open_result(match_id, stage, unit, result.key).load()
            print_files(data, work, Path(scratch), options.rounds)


if __name__ == "__main__":
    main()
