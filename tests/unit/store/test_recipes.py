from __future__ import annotations

import ast
import hashlib
import sys
from pathlib import Path
from typing import Any

import pytest
from store_samples import sample_recipe

from worldpose.errors import StoreError
from worldpose.store.recipes import (
    _read_module,
    _source_cache,
    code_version,
    libraries,
    recipe_differences,
    recipe_key,
)


def describe(old, new):
    return [str(each) for each in recipe_differences(old, new)]


def test_key_is_the_first_half_of_the_sha256_of_the_recipe() -> None:
    text = (
        '{"code":{"worldpose.tracking":"' + "b" * 64 + '"},"contract":1,"inputs":{},'
        '"libraries":{"numpy":"2.4.0"},"match_id":"final","settings":{"gate":{"max_distance":0.5}},'
        '"sources":{"pitch":"' + "a" * 64 + '"},"stage":"tracking","unit":"clip"}'
    )
    assert recipe_key(sample_recipe()) == hashlib.sha256(text.encode()).hexdigest()[:32]


def test_equal_recipes_have_no_difference() -> None:
    assert describe(sample_recipe(), sample_recipe()) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"unit": "late"}, "unit: tracking/clip -> tracking/late"),
        ({"match_id": "semi"}, "match: final -> semi"),
        ({"sources": {"pitch": "f" * 64}}, "source pitch: aaaaaaaaaaaa... -> ffffffffffff..."),
        ({"sources": {}}, "source pitch: aaaaaaaaaaaa... -> absent"),
        ({"inputs": {"ingest/left": "e" * 32}}, "input ingest/left: absent -> eeeeeeeeeeee..."),
        (
            {"settings": {"gate": {"max_distance": 0.7}}},
            "setting gate.max_distance: 0.5 -> 0.7",
        ),
        ({"settings": {"gate": {"max_distance": None}}}, "setting gate.max_distance: 0.5 -> null"),
        (
            {"code": {"worldpose.tracking": "c" * 64}},
            "module worldpose.tracking: bbbbbbbbbbbb... -> cccccccccccc...",
        ),
        ({"libraries": {"numpy": "2.5.0"}}, "library numpy: 2.4.0 -> 2.5.0"),
    ],
)
def test_every_change_has_its_own_line_and_its_own_key(change: dict[str, Any], line: str) -> None:
    changed = sample_recipe(**change)
    assert describe(sample_recipe(), changed) == [line]
    assert recipe_key(changed) != recipe_key(sample_recipe())


def test_digests_that_begin_alike_are_still_a_difference() -> None:
    one = sample_recipe(sources={"pitch": "a" * 64})
    other = sample_recipe(sources={"pitch": "a" * 63 + "b"})
    assert len(describe(one, other)) == 1


def test_a_difference_inside_a_list_is_named_by_its_place() -> None:
    old = sample_recipe().model_copy(update={"sources": {"camera": {"focal_px": [1000.0, 1001.0]}}})
    new = sample_recipe().model_copy(update={"sources": {"camera": {"focal_px": [1000.0, 1002.0]}}})
    assert describe(old, new) == ["source camera.focal_px[1]: 1001.0 -> 1002.0"]


TREE = {
    "tasks/__init__.py": "",
    "tasks/tracking.py": '''
        """Docstring."""
        import os
        import numpy as np
        from tasks import other
        from worldpose.tracking import track
        def run():
            from worldpose.late import slow  # inside a function
            import worldpose.store
    ''',
    "tasks/other.py": "",
    "worldpose/__init__.py": "from worldpose.unrelated import x",
    "worldpose/tracking/__init__.py": "from worldpose.tracking.tracker import track",
    "worldpose/tracking/tracker.py": '''
        """Docstring."""
        from data_contracts import arrays
        from . import affinity
        from ..geometry.rigid import Rigid
        def track(x):
            """Docstring."""
            return x + 1  # comment
    ''',
    "worldpose/tracking/affinity.py": "from .tracker import track",
    "worldpose/tracking/unused.py": "",
    "worldpose/geometry/__init__.py": "from worldpose.unrelated import x",
    "worldpose/geometry/rigid.py": "class Rigid:\n    '''Only a docstring.'''",
    "worldpose/late.py": "import worldpose.deep.module as m",
    "worldpose/deep/__init__.py": "",
    "worldpose/deep/module.py": "",
    "worldpose/unrelated.py": "x = 1",
    "worldpose/store/__init__.py": "import worldpose.unrelated",
    "data_contracts/__init__.py": "",
    "data_contracts/arrays.py": "",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in TREE.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = text.strip("\n").splitlines()
        indent = len(lines[0]) - len(lines[0].lstrip()) if lines else 0
        path.write_text("\n".join(line[indent:] for line in lines))
    return tmp_path


def version_of(tree: Path) -> dict[str, str]:
    forget()
    return code_version("tasks.tracking", (tree,))


def forget() -> None:
    """Read sources again, as a new process would."""
    code_version.cache_clear()
    _read_module.cache_clear()
    _source_cache.cache_clear()


def edited(tree: Path, name: str, old: str, new: str) -> set[str]:
    """The modules whose digest an edit of `name` changes."""
    before = version_of(tree)
    text = (tree / name).read_text()
    assert old in text
    (tree / name).write_text(text.replace(old, new))
    after = version_of(tree)
    return {module for module, version in after.items() if before.get(module) != version}


def test_modules_are_those_that_imports_name(tree: Path) -> None:
    assert list(version_of(tree)) == [
        "data_contracts.arrays",
        "tasks.other",
        "tasks.tracking",
        "worldpose.deep.module",
        "worldpose.geometry.rigid",
        "worldpose.late",
        "worldpose.tracking",
        "worldpose.tracking.affinity",
        "worldpose.tracking.tracker",
    ]


def test_nothing_is_executed(tree: Path) -> None:
    path = tree / "worldpose/tracking/affinity.py"
    path.write_text("raise SystemExit('executed')\nimport sys\n")
    assert "worldpose.tracking.affinity" in version_of(tree)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# comment", "# another comment"),
        ("  # comment", ""),
        ('"""Docstring."""', '"""Another."""'),
        ('    """Docstring."""\n', ""),
        ("x + 1", "(x  +  1)"),
        ("def track", "\n\n\ndef track"),
    ],
)
def test_edit_that_computes_the_same_changes_nothing(tree: Path, old: str, new: str) -> None:
    assert edited(tree, "worldpose/tracking/tracker.py", old, new) == set()


def test_edit_that_computes_something_else_changes_its_module_only(tree: Path) -> None:
    changed = edited(tree, "worldpose/tracking/tracker.py", "x + 1", "x + 2")
    assert changed == {"worldpose.tracking.tracker"}


def test_edit_elsewhere_changes_nothing(tree: Path) -> None:
    assert edited(tree, "worldpose/unrelated.py", "x = 1", "x = 2") == set()


def test_text_that_is_a_value_counts(tree: Path) -> None:
    (tree / "worldpose/late.py").write_text("NAME = 'one'")
    assert edited(tree, "worldpose/late.py", "one", "two") == {"worldpose.late"}


def test_a_data_file_that_a_module_names_counts(tree: Path) -> None:
    (tree / "worldpose/late.py").write_text("PRIOR = 'prior.npz'")
    (tree / "worldpose/prior.npz").write_bytes(b"one")
    (tree / "worldpose/unnamed.npz").write_bytes(b"one")
    before = version_of(tree)
    assert "worldpose.late:prior.npz" in before
    (tree / "worldpose/unnamed.npz").write_bytes(b"two")
    assert version_of(tree) == before
    (tree / "worldpose/prior.npz").write_bytes(b"two")
    after = version_of(tree)
    assert {name for name in after if after[name] != before[name]} == {"worldpose.late:prior.npz"}


def test_version_is_read_once_per_process(tree: Path) -> None:
    before = version_of(tree)
    (tree / "worldpose/late.py").write_text("changed = True")
    assert code_version("tasks.tracking", (tree,)) == before


def test_unknown_module_is_an_error(tree: Path) -> None:
    with pytest.raises(StoreError, match=r"no source of module tasks\.nothing"):
        code_version("tasks.nothing", (tree,))


def test_broken_module_is_an_error_that_names_it(tree: Path) -> None:
    (tree / "worldpose/late.py").write_text("def (")
    with pytest.raises(StoreError, match=r"late\.py: cannot read module worldpose\.late"):
        version_of(tree)


def test_a_parser_that_gives_up_because_of_another_thread_is_asked_again(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = version_of(tree)
    forget()
    parse, left = ast.parse, [3]

    def gives_up(source: bytes) -> ast.Module:
        if left[0]:
            left[0] -= 1
            raise SystemError("AST constructor recursion depth mismatch (before=60, after=89)")
        return parse(source)

    monkeypatch.setattr(ast, "parse", gives_up)
    assert version_of(tree) == before
    assert left == [0]
    forget()
    left[0] = 1_000_000
    with pytest.raises(SystemError):
        version_of(tree)


def test_own_modules_are_found() -> None:
    version = code_version("data_contracts.arrays")
    assert list(version) == ["data_contracts.arrays", "data_contracts.records"]


def test_libraries_are_named_with_versions() -> None:
    versions = libraries()
    assert versions["python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    assert versions["numpy"][0].isdigit()
    assert "store" in versions
