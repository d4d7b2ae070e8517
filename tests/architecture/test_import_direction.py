"""flows -> tasks -> worldpose -> data_contracts, and worldpose knows no orchestrator or network."""

import ast
import functools
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

FORBIDDEN = {
    "data_contracts": {"worldpose", "tasks", "flows", "prefect", "dask", "distributed", "zarr"},
    "worldpose": {
        *("tasks", "flows", "prefect", "prefect_dask", "dask", "distributed"),
        *("socket", "urllib", "http", "requests", "httpx", "aiohttp", "boto3"),
    },
    "tasks": {"flows"},
    "flows": {"tests"},
}

ORDER_IN_WORLDPOSE = (
    *("errors", "cache_folder", "parsing", "sources", "compiled", "geometry", "pickles", "body"),
    *("pitch", "video", "store", "formats", "ingest", "static_calibration", "reference_method"),
    *("review", "detection", "training", "tracking", "camera_consistency", "triangulation"),
    *("bundle_adjustment", "body_fitting", "broadcast_calibration", "filtering", "pipeline"),
    *("evaluation", "dataset", "reports", "simulation"),
)
"""Order inside worldpose/: a package or module may import those before it, never one after it."""


@functools.cache
def imports(path):
    """Return the modules (name, part) that a file imports, and what of them, "" = all."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the direction"
            found += [(node.module, alias.name) for alias in node.names]
    return found


def imported_modules(path):
    return list(dict.fromkeys(module for module, _ in imports(path)))


@pytest.mark.parametrize("package", FORBIDDEN)
def test_imports_point_one_way(package):
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    assert [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in files
        for module in imported_modules(path)
        if module.partition(".")[0] in FORBIDDEN[package]
    ] == []


def test_packages_of_worldpose_have_a_place_in_the_order_and_import_earlier_ones_only():
    top = ROOT / "worldpose"
    files = {path: path.relative_to(top).parts[0].removesuffix(".py") for path in top.rglob("*.py")}
    assert {*files.values()} - {"__init__"} == {*ORDER_IN_WORLDPOSE}
    order = {name: number for number, name in enumerate((*ORDER_IN_WORLDPOSE, "__init__"))}
    assert [
        f"{path.relative_to(ROOT)} imports {module}"
        for path, package in files.items()
        for module in imported_modules(path)
        if module.startswith("worldpose.") and order[module.split(".")[1]] > order[package]
    ] == []


def test_only_the_object_store_module_reaches_for_the_network_library():
    users = {
        path.relative_to(ROOT).as_posix()
        for package in ("worldpose", "data_contracts", "tasks", "flows")
        for path in (ROOT / package).rglob("*.py")
        if "obstore" in {module.partition(".")[0] for module in imported_modules(path)}
    }
    assert users == {"worldpose/store/objects.py"}


def test_only_one_module_reads_npy_arrays():
    reads = re.compile(r"\b(np\.load|load_npz|(npy|format)\.read_\w+|literal_eval)\(")
    users = {
        path.relative_to(ROOT).as_posix()
        for package in ("worldpose", "tasks", "flows")
        for path in (ROOT / package).rglob("*.py")
        for line in path.read_text().splitlines()
        if reads.search(line) and "parse_in_turn(" not in line
    }
    assert users == {"worldpose/parsing.py"}


def test_the_library_imports_without_orchestrators():
    script = (
        "import sys\n"
        "for name in ('prefect', 'dask', 'distributed', 'torch', 'obstore'):\n"
        "    sys.modules[name] = None\n"
        "import worldpose, worldpose.tracking.tracker, worldpose.store.store\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


@pytest.mark.parametrize(
    ("modules", "unwanted"),
    [
        ("flows.running, flows.run_plan, flows.cli.app", "prefect dask distributed"),
        # As each process that a run starts imports it, for the module of `main`.
        ("flows.cli", "typer numpy flows.cli.app"),
    ],
)
def test_deciding_what_to_run_and_starting_processes_import_little(modules, unwanted):
    script = f"import sys, {modules}\nassert not set({unwanted.split()}) & set(sys.modules)\n"
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


def module_imports(root, packages):
    """Return the modules that each module imports, with names that a package passes on resolved."""
    files = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for package in packages
        for path in (root / package).rglob("*.py")
    }
    taken = {name: imports(path) for name, path in files.items()}

    def definer(module, name, importer):
        if f"{module}.{name}" in files:
            return f"{module}.{name}"
        if files[module].name == "__init__.py" and importer != module:
            for source, passed in taken[module]:
                if passed == name and source in files:
                    return definer(source, name, module)
        return module

    return {
        name: {definer(*each, name) for each in imported if each[0] in files} - {name}
        for name, imported in taken.items()
    }


def test_no_modules_import_each_other_in_a_circle():
    TopologicalSorter(module_imports(ROOT, FORBIDDEN)).prepare()


HEAVY = ("numba", "scipy", "cv2", "av", "zarr", "xarray", "torch", "pandas", "matplotlib")


def test_settings_and_readers_of_stages_and_the_plan_of_a_run_import_no_estimator():
    stages = ("tracking", "body_fitting", "bundle_adjustment")
    modules = ", ".join(f"worldpose.{name}.settings" for name in stages)
    modules += ", worldpose.ingest.match_folder"
    # Prefect's server and the workers start after these.
    modules += ", flows.cli.run, flows.registering, flows.running"
    script = f"import sys, {modules}; print(*sorted({set(HEAVY)} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, []), done.stderr
