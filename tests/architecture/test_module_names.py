"""Every module of the tests has a name of its own: pytest imports them side by side."""

from collections import Counter
from pathlib import Path

TESTS = Path(__file__).parents[1]
BY_FOLDER = {"conftest.py", "sitecustomize.py"}
"""Found by the folder they lie in, never imported by name."""


def repeated_names(root):
    names = Counter(path.name for path in root.rglob("*.py"))
    return {name for name, count in names.items() if count > 1} - BY_FOLDER


def test_no_two_modules_of_the_tests_have_one_name():
    assert repeated_names(TESTS) == set()


def test_a_name_that_is_there_twice_is_found(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        for name in ("conftest.py", "test_same.py", f"test_{folder}.py"):
            (tmp_path / folder / name).touch()
    assert repeated_names(tmp_path) == {"test_same.py"}
