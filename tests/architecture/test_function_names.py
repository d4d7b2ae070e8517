"""No function is named by a bare participle: a name says what it does, or what it returns."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("data_contracts", "worldpose", "tasks", "flows", "infra", "benchmarks", "examples")
IRREGULAR = (
    "begun bent bought broken brought built caught chosen dealt done drawn driven fallen felt "
    "flown forgotten found frozen given gone grown held hidden hung kept known laid lent lost made "
    "meant met paid said seen sent shaken shown slept sought spent spoken spun stolen struck stuck "
    "sunk sworn taken taught thought thrown told torn understood won worn woven written"
)
NO_PARTICIPLE = "bring embed exceed feed king need proceed ring seed speed spring string thing"
"""Words that only end like a participle."""


def is_participle(word):
    regular = word.endswith(("ed", "ing")) and word not in NO_PARTICIPLE.split()
    return "_" not in word and (regular or word in IRREGULAR.split())


def decorators(function):
    for each in function.decorator_list:
        called = each.func if isinstance(each, ast.Call) else each
        yield called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")


def participles(source):
    """Return the functions and methods of one file that a bare participle names.

    Properties are values, and the tasks of the stages bear the names of the stages.
    """
    return [
        node.name
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and is_participle(node.name.strip("_"))
        and not {"property", "cached_property", "unit_task"} & set(decorators(node))
    ]


def test_no_function_is_named_by_a_bare_participle():
    files = [
        path
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
        if "node_modules" not in path.parts
    ]
    assert len(files) > 400
    found = {str(path): participles(path.read_text(encoding="utf-8")) for path in files}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize("name", ["joined", "_whitened", "taken", "publishing", "_held"])
def test_a_participle_is_found_in_functions_methods_and_nested_functions(name):
    body = f"def {name}():\n    pass\n"
    nested = body.replace("\n", "\n    ").rstrip()
    for source in (body, f"async {body}", f"class A:\n    {nested}", f"def f():\n    {nested}"):
        assert participles(source) == [name]


@pytest.mark.parametrize(
    "source",
    [
        "def join():\n    pass\n",
        "def list_held_units():\n    pass\n",
        "def unit_failed():\n    pass\n",
        "def speed():\n    pass\n",
        "def string():\n    pass\n",
        "class A:\n    @property\n    def hidden(self):\n        pass\n",
        "@unit_task(1)\ndef tracking():\n    pass\n",
    ],
)
def test_verbs_values_and_stages_are_right(source):
    assert participles(source) == []
