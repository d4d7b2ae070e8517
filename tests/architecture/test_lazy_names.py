"""Packages import names on first use, and type checkers read them from the same modules."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAZY = [
    path
    for path in (ROOT / "worldpose").rglob("__init__.py")
    if "import_on_use" in path.read_text()
]
HEAVY = ("numba", "scipy", "cv2", "av", "zarr", "xarray", "torch", "pandas", "matplotlib")


def named(path):
    """Names by module, as type checkers see them, and as they are imported on first use."""
    seen, used = {}, {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for each in node.body:
                seen.setdefault(each.module, set()).update(alias.name for alias in each.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "import_on_use":
            used = {module: set(names) for module, names in ast.literal_eval(node.args[1]).items()}
    return seen, used


@pytest.mark.parametrize("path", LAZY, ids=lambda path: path.parent.name)
def test_names_are_imported_from_where_type_checkers_see_them(path):
    seen, used = named(path)
    assert seen == used
    package = importlib.import_module(".".join(path.parent.relative_to(ROOT).parts))
    assert set(package.__all__) == set().union(*used.values())
    for module, names in used.items():
        for name in names:
            assert getattr(package, name) is getattr(importlib.import_module(module), name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        package.nothing  # noqa: B018


@pytest.mark.parametrize("name", ["tracking", "body_fitting", "bundle_adjustment", "ingest"])
def test_the_settings_and_readers_of_a_stage_import_no_estimator(name):
    module = "worldpose.ingest.match_folder" if name == "ingest" else f"worldpose.{name}.settings"
    assert heavy_imports_of(module) == []


def test_a_run_is_planned_without_an_estimator():
    # Prefect's server and the workers start after that.
    assert heavy_imports_of("flows.cli.run, flows.registering, flows.running") == []


def heavy_imports_of(modules):
    """Heavy modules that a process has after importing these."""
    script = f"import sys, {modules}; print(*sorted({set(HEAVY)} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()
