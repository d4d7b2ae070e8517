"""The pages of the method name functions that exist."""

import importlib
import re
from pathlib import Path

import pytest

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
