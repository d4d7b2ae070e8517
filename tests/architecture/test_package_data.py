"""An installation contains every file of the packages, since users do not install in place."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
ONLY_FOR_TESTS = {"flows/web/static/built_from.sha256"}


def test_an_installation_holds_every_file_of_the_packages():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = {pattern.removesuffix("*") for pattern in tools["packages"]["find"]["include"]}
    listed = {
        path
        for package, patterns in tools["package-data"].items()
        for pattern in patterns
        for path in (ROOT / package).glob(pattern)
    }
    present = {
        path
        for package in packages
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }
    assert {path.relative_to(ROOT).as_posix() for path in present - listed} == ONLY_FOR_TESTS
    assert listed <= present


def test_every_pattern_of_package_data_matches_a_file():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    for package, patterns in tools["package-data"].items():
        for pattern in patterns:
            assert list((ROOT / package).glob(pattern)), f"{package}: {pattern}"
