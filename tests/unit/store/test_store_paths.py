from __future__ import annotations

from pathlib import Path

import pytest

from worldpose.errors import InputError
from worldpose.store.paths import ResultId
from worldpose.store.store import Store

BAD = ["", "/", "/etc/passwd", "..", "a/../b", "a/..", "./a", "a//b", "a/", "a\0b", "a\nb", "a\\b"]


def test_path_that_could_leave_the_project_is_refused_by_every_method(
    store: Store, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    blobs = store.blobs
    for path in BAD:
        for call in (
            lambda path=path: blobs.read(path),
            lambda path=path: blobs.exists(path),
            lambda path=path: blobs.put(path, b"x"),
            lambda path=path: blobs.put_new(path, b"x"),
            lambda path=path: blobs.delete(path),
            lambda path=path: blobs.delete_tree(path, "manifest.json"),
            lambda path=path: blobs.entries(path),
        ):
            with pytest.raises(InputError, match="path inside a project"):
                call()
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("key", ["", "0" * 31, "0" * 33, "G" * 32, "A" * 32, "../" + "0" * 29])
def test_key_that_is_no_key_is_refused(key: str) -> None:
    with pytest.raises(InputError, match="32 lower-case"):
        ResultId("final", "tracking", "clip", key)
