"""The measures of structure on planted trees, and the bounds that the code keeps."""

import graphlib

import pytest
from structure import MAX_ENGINE_FILES, ROOT, Structure


@pytest.fixture(scope="module")
def project():
    """The structure of the project, whose files are parsed once."""
    return Structure()


@pytest.fixture
def planted(tmp_path):
    """Return the structure of modules with the given sources, by path."""

    def plant(sources):
        for name, source in sources.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(source)
        return Structure(tmp_path, ("one",))

    return plant


CHAIN = {
    "one/__init__.py": "from one.c import value",
    "one/a.py": "from one import value",
    "one/b.py": "from one.c import value",
    "one/c.py": "value = 1",
    "one/alone.py": "",
}


def test_a_name_passed_on_by_a_package_counts_for_its_definer(planted):
    structure = planted(CHAIN)
    assert structure.imports["one.a"] == {"one.c"}
    assert structure.cycles() == []
    assert structure.chain()[-1] == "one.c"


def test_a_circle_is_found_through_three_modules(planted):
    structure = planted(
        {
            "one/__init__.py": "",
            "one/a.py": "import one.b",
            "one/b.py": "def late():\n    from one import c",
            "one/c.py": "import one.a",
            "one/d.py": "import one.a",
        }
    )
    assert structure.cycles() == ["one.a, one.b, one.c"]
    with pytest.raises(graphlib.CycleError):
        structure.chain()


def test_a_module_with_one_importer_long_signatures_and_starred_calls_are_found(planted):
    structure = planted(
        {
            "one/a.py": "import one.b\ngiven = (1, 2)\none.b.many(*given)\nzip(*given)",
            "one/b.py": "def many(a, b, c, d, e, f, g, h, i): ...",
        }
    )
    assert structure.one_importer() == ["one.b (1 lines) <- one.a"]
    assert structure.parameters() == ["one.b.many: 9"]
    assert [each.split(":")[0] for each in structure.starred_calls()] == ["one.a"]


def test_no_modules_import_each_other_in_a_circle(project):
    assert project.cycles() == []


def test_no_file_has_more_than_600_lines(project):
    assert project.long_files() == []


def test_no_function_has_more_than_eight_parameters(project):
    assert project.parameters() == []


def test_no_call_hides_the_names_of_its_arguments(project):
    assert project.starred_calls() == []


def test_the_engine_of_flows_is_visible():
    assert len(list((ROOT / "flows").glob("*.py"))) <= MAX_ENGINE_FILES
