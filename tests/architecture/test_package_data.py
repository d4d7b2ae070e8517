"""An installation contains every file of the packages, since users do not install in place."""

import importlib
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ONLY_FOR_TESTS = {"flows/web/static/built_from.sha256"}


def test_an_installation_holds_every_file_of_the_packages():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = {pattern.removesuffix("*") for pattern in tools["packages"]["find"]["include"]}
    listed = set()
    for package, patterns in tools["package-data"].items():
        for pattern in patterns:
            files = list((ROOT / package).glob(pattern))
            assert files, f"{package}: {pattern} matches no file"
            listed.update(files)
    present = {
        path
        for package in packages
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }
    assert {path.relative_to(ROOT).as_posix() for path in present - listed} == ONLY_FOR_TESTS
    assert listed <= present


PAGES = sorted((Path(__file__).parents[2] / "docs" / "method").glob("*.md"))
NAME = re.compile(r"`((?:worldpose|tasks|flows)\.[\w.]+)`")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_name_of_a_page_exists(page):
    names = NAME.findall(page.read_text(encoding="utf-8"))
    assert names
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError:
            module, _, part = name.rpartition(".")
            assert hasattr(importlib.import_module(module), part), name


def test_the_table_has_each_equation_of_the_paper():
    page = next(page for page in PAGES if page.stem == "index").read_text(encoding="utf-8")
    equations = [line for line in page.partition("## The paper's")[2].splitlines() if "`" in line]
    assert len(equations) == 19


def test_every_promise_of_the_threat_model_names_tests_that_there_are():
    page = (Path(__file__).parents[2] / "docs/explanation/security.md").read_text(encoding="utf-8")
    table = page.partition("## Who may do what")[2].partition("## Measures")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ")][2:]
    assert len(rows) >= 10 and all("`test_" in row for row in rows)
    here = "\n".join(file.read_text() for file in Path(__file__).parents[1].rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", page):
        assert f"def {name}(" in here, name
