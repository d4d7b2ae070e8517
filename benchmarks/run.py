"""Runs one benchmark, prints its tables, and records them as data.

    python benchmarks/run.py --list
    python benchmarks/run.py NAME [options] [--json [FILE]]
    python benchmarks/run.py NAME --help

`--json` writes the tables to docs/results/data/NAME.json, or to FILE, with the command, the date,
the machine and the versions. Peers run in the same process as ours, with a ratio beside them.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from registry import REGISTRY, Benchmark, Tables, as_data, format_table

from worldpose.errors import WorldposeError

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "results" / "data"
MODULES = (
    *("speed_cameras", "speed_people", "costs", "second_world"),
    *("camera_accuracy", "camera_faults", "camera_changes", "bodies"),
    *("real", "shelf", "mvor", "line_sets", "real_cameras", "stills", "pose2sim_demo"),
    "result_digests",
)
"""Modules that register benchmarks, in the order of the list."""
PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "torch", "onnxruntime", "zarr")


def load_benchmarks() -> dict[str, Benchmark]:
    """Return all benchmarks by name."""
    for name in MODULES:
        importlib.import_module(name)
    return REGISTRY


def describe_machine() -> dict[str, Any]:
    """Return the processor's name, the number of cores and the memory [GB]."""
    names = [line for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    cpu = names[0].partition(":")[2].strip() if names else platform.processor()
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    return {"cpu": cpu, "cores": os.cpu_count(), "memory_gb": round(memory, 1)}


def _lines(path: str) -> list[str]:
    return Path(path).read_text(encoding="utf-8").splitlines() if Path(path).exists() else []


def list_versions() -> dict[str, str]:
    """Return the versions of Python, of packages, and of this code."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    code = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    done = subprocess.run(code, capture_output=True, text=True, check=False)
    return {**found, "worldpose": done.stdout.strip() or version("worldpose")}


def record(name: str, words: Sequence[str], tables: Tables, seconds: float) -> dict[str, Any]:
    """Return what `--json` writes; folders of this machine appear by their last part alone."""
    words = [Path(word).name if Path(word).is_absolute() else word for word in words]
    return {
        "benchmark": name,
        "command": shlex.join(["python", "benchmarks/run.py", *words]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "seconds": round(seconds, 1),
        "machine": describe_machine(),
        "versions": list_versions(),
        "tables": {key: as_data(asdict(table)) for key, table in tables.items()},
    }


def parse(words: Sequence[str]) -> tuple[Benchmark | None, argparse.Namespace]:
    """Return the asked benchmark and its options; None for the list."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="print a line for each benchmark")
    parts = parser.add_subparsers(dest="name", metavar="NAME")
    for each in load_benchmarks().values():
        part = parts.add_parser(
            each.name,
            help=each.line,
            description=each.run.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        part.add_argument(
            "--json", type=Path, nargs="?", const=DATA / f"{each.name}.json", metavar="FILE"
        )
        for names, how in each.options:
            part.add_argument(*names, **how)
    options = parser.parse_args(words)
    if not options.list and options.name is None:
        parser.error("expected the name of a benchmark; --list prints them")
    return (None if options.list else REGISTRY[options.name]), options


def main(words: Sequence[str] | None = None) -> Tables:
    """Run a benchmark, or list all; return the tables."""
    words = sys.argv[1:] if words is None else words
    chosen, options = parse(words)
    if chosen is None:
        for each in REGISTRY.values():
            print(f"{each.name:24}{each.line}")
        return {}
    begin = time.monotonic()
    try:
        tables = chosen.run(options)
    except WorldposeError as error:
        sys.exit(f"error: {error}")
    for table in tables.values():
        print(format_table(table))
    if options.json is not None:
        data = record(chosen.name, words, tables, time.monotonic() - begin)
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        print(f"{options.json} written", file=sys.stderr)
    return tables


if __name__ == "__main__":
    main()
