from __future__ import annotations

import ast
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from worldpose.store import recipes
from worldpose.store.recipes import Import, SourceCache, parse_source

SOURCE = b'''
"""Docstring."""
import numpy as np
from . import affinity
def load():
    """Docstring."""
    from ..geometry.rigid import Rigid, Pose
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
        Import("numpy", 0, []),
        Import("", 1, ["affinity"]),
        Import("geometry.rigid", 2, ["Rigid", "Pose"]),
    ]
    assert parsed.data == ["prior.npz"]
    assert parsed.code == parse_source(SOURCE.replace(b"Docstring", b"Other")).code


def test_the_next_process_parses_nothing(written: Path, parsed_sources: list[bytes]) -> None:
    read = SourceCache(written).parse("worldpose.one", SOURCE)
    assert parsed_sources == []
    assert read == parse_source(SOURCE)


def test_another_source_of_the_module_is_parsed(written: Path) -> None:
    changed = SOURCE.replace(b"prior", b"later")
    cache = SourceCache(written)
    assert cache.parse("worldpose.one", changed).data == ["later.npz"]
    cache.save()
    assert SourceCache(written).parse("worldpose.one", changed) == parse_source(changed)


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


def test_a_file_of_another_parser_is_parsed_again(
    written: Path, parsed_sources: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recipes, "_parser_version", lambda: b"another Python")
    SourceCache(written).parse("worldpose.one", SOURCE)
    assert parsed_sources == [SOURCE]


def test_a_folder_that_cannot_be_made_changes_no_answer(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    cache = SourceCache(tmp_path / "file" / "sources.json")
    assert cache.parse("worldpose.one", SOURCE) == parse_source(SOURCE)
    cache.save()


def test_a_failed_write_leaves_no_file(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise OSError("the disk is full")

    before = written.read_bytes()
    monkeypatch.setattr(Path, "replace", fails)
    cache = SourceCache(written)
    cache.parse("worldpose.two", b"x = 1")
    cache.save()
    assert [each.name for each in written.parent.iterdir()] == [written.name]
    assert written.read_bytes() == before


def test_a_broken_source_is_not_kept(path: Path) -> None:
    cache = SourceCache(path)
    for _ in range(2):
        with pytest.raises(SyntaxError):
            cache.parse("worldpose.one", b"def (")
    cache.save()
    assert not path.exists()


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
