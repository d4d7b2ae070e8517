"""One behaviour of two media."""

import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from obstore.store import MemoryStore
from store_samples import place, run_once

from worldpose.errors import StoreError
from worldpose.store import blobs as folder_module
from worldpose.store import objects
from worldpose.store.integrity import verify
from worldpose.store.store import Store


def test_what_is_put_is_read(store):
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


def test_of_many_that_put_one_new_file_one_succeeds(store):
    values = [digit * 1000 for digit in (b"0", b"1", b"2", b"3")]
    for number in range(5):
        path = f"race/{number}"
        with ThreadPoolExecutor(4) as pool:
            done = list(pool.map(lambda value, path=path: store.blobs.put_new(path, value), values))
        assert sum(done) == 1
        assert store.blobs.read(path) == values[done.index(True)]
    assert not store.blobs.put_new(path, b"later") and store.blobs.staged_entries() == []


@pytest.fixture(params=[errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS])
def without_links(request, monkeypatch):
    """What exFAT, SMB and FUSE answer to link()."""

    def fail(*_, **__):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(os, "link", fail)


@pytest.fixture
def losing_replies(monkeypatch):
    """Execute every link and rename twice, as NFS does when the first reply is lost."""
    link, rename = os.link, Path.rename

    def link_twice(source, target):
        link(source, target)
        link(source, target)

    def rename_twice(source, target):
        rename(source, target)
        return rename(source, target)

    monkeypatch.setattr(os, "link", link_twice)
    monkeypatch.setattr(Path, "rename", rename_twice)


@pytest.mark.usefixtures("losing_replies")
def test_a_lost_reply_to_the_rename_of_a_result_is_success(tmp_path):
    store = Store.create(tmp_path / "project")
    assert run_once(store) == "0001"
    assert store.has(*place())
    assert verify(store) == ()


@pytest.mark.usefixtures("without_links")
def test_without_hard_links_a_file_is_still_created_whole_and_once(tmp_path):
    store = Store.create(tmp_path / "project")
    with ThreadPoolExecutor(8) as pool:
        contents = [f"{number} ".encode() * 10_000 for number in range(16)]
        done = list(pool.map(lambda data: store.blobs.put_new("a/b.json", data), contents))
    assert sum(done) == 1
    assert store.blobs.read("a/b.json") == contents[done.index(True)]
    assert store.blobs.staged_entries() == []
    run_once(store)
    assert verify(store) == ()


@pytest.mark.usefixtures("without_links")
def test_a_disk_with_neither_links_nor_exclusive_renames_is_refused_with_the_cause(
    tmp_path, monkeypatch
):
    def fail(*_):
        folder_module.ctypes.set_errno(errno.EINVAL)
        return -1

    class Library:
        renameat2 = staticmethod(fail)

    monkeypatch.setattr(folder_module.ctypes, "CDLL", lambda *_, **__: Library)
    with pytest.raises(StoreError, match="neither hard links") as caught:
        Store.create(tmp_path / "project")
    assert "permission to it" not in str(caught.value)
    assert "ext4" in str(caught.value)


def test_a_disk_that_syncs_no_folders_is_fine(tmp_path, monkeypatch):
    sync = os.fsync

    def only_files(descriptor):
        if Path(f"/proc/self/fd/{descriptor}").is_dir():
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", only_files)
    store = Store.create(tmp_path / "project")
    run_once(store)
    assert verify(store) == ()


def test_a_local_disk_that_fails_a_download_is_not_blamed_on_the_bucket(tmp_path, monkeypatch):
    pieces = [b"ab", b"cd"]

    class Answer:
        def stream(self):
            return iter(pieces)

    monkeypatch.setattr(objects.obstore, "get", lambda *_: Answer())
    blobs = objects.ObjectBlobs.at("s3://bucket/project")
    (tmp_path / "there").write_bytes(b"")
    with pytest.raises(FileExistsError, match="there"):
        blobs.download("a/b", tmp_path / "there")
    blobs.download("a/b", tmp_path / "new")
    assert (tmp_path / "new").read_bytes() == b"abcd"

    def broken(*_):
        raise OSError("connection reset")

    monkeypatch.setattr(objects.obstore, "get", broken)
    with pytest.raises(StoreError, match="Check the bucket"):
        blobs.download("a/b", tmp_path / "other")


@pytest.mark.parametrize("name", ["settings/project.yaml", "matches/m.json"])
def test_a_file_below_a_folder_of_object_storage_has_a_mark(name):
    blobs = objects.ObjectBlobs("bucket", "")
    vars(blobs)["_s3"] = MemoryStore()
    assert blobs.marks([name]) == [0]
    blobs.put(name, b"1")
    (before,) = blobs.marks([name])
    blobs.put(name, b"22")
    (after,) = blobs.marks([name])
    assert 0 not in (before, after) and before != after
    many = [f"runs/{number}" for number in range(objects.LISTINGS + 1)]
    assert blobs.marks([name, *many])[0] == after
