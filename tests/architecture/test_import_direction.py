"""flows -> tasks -> worldpose -> data_contracts, and worldpose knows no orchestrator or network."""

import ast
import subprocess
import sys
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

STAGES_IN_WORLDPOSE = (
    "cameras",
    "pitch",
    "ingest",
    "static_calibration",
    "detection",
    "training",
    "tracking",
    "camera_consistency",
    "triangulation",
    "bundle_adjustment",
    "body",
    "body_fitting",
    "broadcast_calibration",
    "filtering",
    "redetection",
    "release",
    "evaluation",
    "synthetic",
)
"""Order inside worldpose/: a package may import those before it, never one after it."""


def imported_modules(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the direction"
            yield node.module


def backward_imports(package, forbidden, root=ROOT):
    return [
        f"{path.relative_to(root)} imports {module}"
        for path in sorted((root / package).rglob("*.py"))
        for module in imported_modules(path)
        if module.partition(".")[0] in forbidden
    ]


@pytest.mark.parametrize("package", FORBIDDEN)
def test_imports_point_one_way(package):
    assert (ROOT / package).is_dir()
    assert backward_imports(package, FORBIDDEN[package]) == []


def test_a_backward_import_is_seen(tmp_path):
    (tmp_path / "worldpose").mkdir()
    (tmp_path / "worldpose" / "late.py").write_text("def f():\n    from flows.match import x\n")
    assert backward_imports("worldpose", FORBIDDEN["worldpose"], tmp_path) == [
        "worldpose/late.py imports flows.match"
    ]


def test_stages_import_earlier_ones_only():
    place = {name: number for number, name in enumerate(STAGES_IN_WORLDPOSE)}
    backward = []
    for package in STAGES_IN_WORLDPOSE:
        for path in sorted((ROOT / "worldpose" / package).rglob("*.py")):
            for module in imported_modules(path):
                parts = module.split(".")
                if parts[0] == "worldpose" and len(parts) > 1:
                    backward += [
                        f"{path.name} imports {module}"
                        for _ in [0]
                        if place.get(parts[1], -1) > place[package]
                    ]
    assert backward == []


def test_only_the_object_store_module_reaches_for_the_network_library():
    users = {
        path.relative_to(ROOT).as_posix()
        for package in ("worldpose", "data_contracts", "tasks", "flows")
        for path in (ROOT / package).rglob("*.py")
        if "obstore" in {module.partition(".")[0] for module in imported_modules(path)}
    }
    assert users == {"worldpose/store/objects.py"}


@pytest.mark.parametrize("package", ["worldpose", "worldpose.tracking", "worldpose.store"])
def test_the_library_imports_without_orchestrators(package):
    script = (
        "import sys\n"
        "for name in ('prefect', 'dask', 'distributed', 'torch', 'obstore'):\n"
        "    sys.modules[name] = None\n"
        f"import {package}\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


def test_deciding_what_to_run_imports_neither_prefect_nor_dask():
    script = (
        "import sys\n"
        "import flows.running, flows.planning, flows.cli.app\n"
        "loaded = {'prefect', 'dask', 'distributed'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


def test_processes_that_a_run_starts_import_no_command():
    script = (
        "import sys\n"
        "import flows.cli\n"  # as each of them does, for the module of `main`
        "loaded = {'typer', 'numpy', 'flows.cli.app'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


def test_no_file_is_a_drawer_for_odds_and_ends():
    drawers = {"utils.py", "helpers.py", "common.py", "misc.py"}
    found = [
        path
        for package in FORBIDDEN
        for path in (ROOT / package).rglob("*.py")
        if path.name in drawers
    ]
    assert found == []
