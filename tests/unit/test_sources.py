from __future__ import annotations

import ast
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from worldpose.errors import StoreError
from worldpose.sources import (
    SourceCache,
    _read_module,
    _source_cache,
    code_version,
    parse_source,
)

SOURCE = b'''
"""Docstring."""
import numpy as np
from worldpose.tracking import affinity
def load():
    """Docstring."""
    from worldpose.geometry.rigid import Rigid, Pose
    return "prior.npz"
'''


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new" / "sources.json"


@pytest.fixture
def written(path: Path) -> Path:
    cache = SourceCache(path)
    cache.parse("worldpose.one", SOURCE)
    cache.save()
    return path


@pytest.fixture
def parsed_sources(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    parsed: list[bytes] = []
    parse = ast.parse
    monkeypatch.setattr(ast, "parse", lambda source: parsed.append(source) or parse(source))
    return parsed


def test_a_source_has_its_imports_and_names_of_data() -> None:
    parsed = parse_source(SOURCE)
    assert parsed.imports == [
        "numpy",
        "worldpose.tracking.affinity",
        "worldpose.geometry.rigid.Rigid",
        "worldpose.geometry.rigid.Pose",
    ]
    assert parsed.data == ["prior.npz"]
    assert parsed.code == parse_source(SOURCE.replace(b"Docstring", b"Other")).code


def test_the_next_process_parses_nothing(written: Path, parsed_sources: list[bytes]) -> None:
    read = SourceCache(written).parse("worldpose.one", SOURCE)
    assert parsed_sources == []
    assert read == parse_source(SOURCE)


@pytest.mark.parametrize(
    ("old", "new"), [(b"geometry", b"geometrx"), (b'"numpy"', b'""'), (b"\n", b""), (b"}", b"")]
)
def test_a_damaged_file_is_parsed_again(
    written: Path, old: bytes, new: bytes, parsed_sources: list[bytes]
) -> None:
    content = written.read_bytes()
    assert old in content
    written.write_bytes(content.replace(old, new, 1))
    cache = SourceCache(written)
    cache.parse("worldpose.one", SOURCE)
    assert parsed_sources == [SOURCE]
    cache.save()
    assert written.read_bytes() == content


def test_a_folder_that_cannot_be_made_changes_no_answer(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    cache = SourceCache(tmp_path / "file" / "sources.json")
    assert cache.parse("worldpose.one", SOURCE) == parse_source(SOURCE)
    cache.save()


def test_writers_at_once_leave_a_whole_file(path: Path) -> None:
    def write(number: int) -> None:
        cache = SourceCache(path)
        for module in range(20):
            cache.parse(f"worldpose.part{module}", f"x = {number}".encode())
        cache.save()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(32)))
    kept = SourceCache(path)._modules
    assert len(kept) == 20
    assert len({identity for identity, _ in kept.values()}) == 1
    assert list(path.parent.iterdir()) == [path]


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
