"""One behaviour of two media."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

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
