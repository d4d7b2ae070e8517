from __future__ import annotations

from pathlib import Path

import pytest

from worldpose.sources import _read_module, _source_cache, code_version

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
        from worldpose.tracking import affinity
        from worldpose.geometry.rigid import Rigid
        def track(x):
            """Docstring."""
            return x + 1  # comment
    ''',
    "worldpose/tracking/affinity.py": "from worldpose.tracking.tracker import track",
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


@pytest.mark.parametrize(
    ("module", "old", "new", "changed"),
    [
        ("tracking/tracker", "x + 1", "x + 2", {"worldpose.tracking.tracker"}),
        ("unrelated", "x = 1", "x = 2", set()),
    ],
)
def test_edit_that_computes_something_else_changes_its_module_only(
    tree: Path, module: str, old: str, new: str, changed: set[str]
) -> None:
    assert edited(tree, f"worldpose/{module}.py", old, new) == changed
