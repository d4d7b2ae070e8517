"""One behaviour of two media."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from obstore.store import MemoryStore

from worldpose.errors import StoreError
from worldpose.store import objects
from worldpose.store.store import Store


def test_what_is_put_is_read(store: Store) -> None:
    blobs = store.blobs
    assert blobs.read("a/b") is None
    assert not blobs.exists("a/b")
    blobs.put("a/b", b"1")
    blobs.put("a/b", b"22")
    assert blobs.read("a/b") == b"22"
    assert blobs.exists("a/b")
    assert blobs.read("a/b/c") is None
    blobs.delete("a/b")
    blobs.delete("a/b")
    assert blobs.read("a/b") is None


def test_new_is_put_once(store: Store) -> None:
    assert store.blobs.put_new("a/b", b"first")
    assert not store.blobs.put_new("a/b", b"second")
    assert store.blobs.read("a/b") == b"first"
    assert store.blobs.staged_entries() == []


def test_of_many_that_put_one_new_file_one_succeeds(store: Store) -> None:
    for number in range(5):
        with ThreadPoolExecutor(4) as pool:
            done = list(
                pool.map(
                    lambda value, path=f"race/{number}": store.blobs.put_new(path, value),
                    [b"0" * 1000, b"1" * 1000, b"2" * 1000, b"3" * 1000],
                )
            )
        assert sum(done) == 1
        assert store.blobs.read(f"race/{number}") == str(done.index(True)).encode() * 1000


def test_a_local_disk_that_fails_a_download_is_not_blamed_on_the_bucket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces = [b"ab", b"cd"]

    class Answer:
        def stream(self) -> Iterator[bytes]:
            return iter(pieces)

    monkeypatch.setattr(objects.obstore, "get", lambda *_: Answer())
    blobs = objects.ObjectBlobs.at("s3://bucket/project")
    (tmp_path / "there").write_bytes(b"")
    with pytest.raises(FileExistsError, match="there"):
        blobs.download("a/b", tmp_path / "there")
    blobs.download("a/b", tmp_path / "new")
    assert (tmp_path / "new").read_bytes() == b"abcd"

    def broken(*_: object) -> None:
        raise OSError("connection reset")

    monkeypatch.setattr(objects.obstore, "get", broken)
    with pytest.raises(StoreError, match="Check the bucket"):
        blobs.download("a/b", tmp_path / "other")


@pytest.mark.parametrize("name", ["settings/project.yaml", "matches/m.json"])
def test_a_file_below_a_folder_of_object_storage_has_a_mark(name: str) -> None:
    blobs = objects.ObjectBlobs("bucket", "")
    vars(blobs)["_s3"] = MemoryStore()
    assert blobs.marks([name]) == [0]
    blobs.put(name, b"1")
    (before,) = blobs.marks([name])
    blobs.put(name, b"22")
    (after,) = blobs.marks([name])
    assert 0 not in (before, after) and before != after
    assert blobs.marks([name] * (objects.LISTINGS + 1))[0] == after
