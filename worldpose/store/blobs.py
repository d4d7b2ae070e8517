"""Files of a project: their interface, and the implementation for a local folder.

The implementation for object storage is `worldpose.store.objects`.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path
from typing import Final, Protocol, TypeVar

from worldpose.errors import StoreError
from worldpose.store.paths import STAGING, checked_path

COMMIT_POINTS = (
    *("before_write", "after_write", "before_publish", "during_publish", "before_commit"),
    *("after_commit", "before_run_record", "after_run_record"),
)
"""In execution order.

`before_write`, `after_write`: around the arrays in private staging. `before_publish`: all is hashed
and nothing is outside staging. `during_publish`: some data is durable, no manifest anywhere.
`before_commit`, `after_commit`: around the one atomic step that makes the result exist, which is a
rename in a folder and the manifest's creation in object storage. `before_run_record`,
`after_run_record`: around the creation of the run's record.
"""

_hook: Callable[[str], None] | None = None


def install_fault_hook(hook: Callable[[str], None] | None) -> None:
    """Call `hook` with the name of every commit point from now on, in fault tests; None ends it."""
    global _hook
    _hook = hook


def pass_commit_point(point: str) -> None:
    """Call the installed hook, if any, with the name of the current `point`."""
    if _hook is not None:
        _hook(point)


@dataclass(frozen=True)
class Entry:
    """One file or object."""

    path: str
    """Relative to the root."""
    size: int
    """[byte]"""
    modified: datetime


class Blobs(Protocol):
    """Files by path below one root. Every method raises StoreError if the medium fails."""

    @property
    def url(self) -> str:
        """The root, in the user's notation."""

    def read(self, path: str) -> bytes | None:
        """Return the content at `path`, None if there is none."""

    def read_range(self, path: str, start: int, stop: int) -> bytes | None:
        """Return the bytes from `start` to before `stop` or the end; None without content."""

    def digest(self, path: str) -> tuple[int, str] | None:
        """Return size [byte] and SHA-256 of the content at `path`, None if there is none."""

    def exists(self, path: str) -> bool:
        """Return whether `path` exists."""

    def put_new(self, path: str, data: bytes) -> bool:
        """Create `path` whole and durable; return False without a change if it exists."""

    def put(self, path: str, data: bytes) -> None:
        """Replace the content at `path` atomically."""

    def delete(self, path: str) -> None:
        """Remove the file at `path`, if it exists."""

    def delete_tree(self, prefix: str, first: str) -> None:
        """Remove all files below `prefix`: `first` before the others, so no reader sees a part."""

    def entries(self, prefix: str) -> list[Entry]:
        """Return all files below the folder `prefix`, sorted by path."""

    def marks(self, paths: Sequence[str]) -> list[int]:
        """Return for each file or folder a number that differs after a change; 0 if it is absent.

        A folder changes when a name in it appears or disappears. On a disk it is the time of the
        change [ns]: a change that preserves it is missed.
        """

    def create_staging(self) -> Path:
        """Create a private local folder for a tree to be published."""

    def staged_entries(self) -> list[Entry]:
        """Return the content of this root's staging, with the time of the last write."""

    def publish_tree(self, folder: Path, prefix: str, manifest_name: str, manifest: bytes) -> bool:
        """Publish a staged folder at `prefix`, manifest last; False if one is published there."""


_TODO = {
    errno.ENOSPC: "Free space there and run again",
    errno.EDQUOT: "Free space there or raise the quota, and run again",
    errno.EFBIG: "Raise the limit on file sizes (ulimit -f) and run again",
    errno.EROFS: "Make it writable or use another project folder, and run again",
    errno.EACCES: "Give this user permission to it and run again",
    errno.EPERM: "Give this user permission to it and run again",
}


@contextmanager
def storage_errors(path: str) -> Iterator[None]:
    """Convert the system's errors at `path` to a StoreError that says what to do."""
    try:
        yield
    except OSError as error:
        todo = _TODO.get(error.errno or 0, "Repair the cause and run again")
        # For a copy or a rename, the second file is the one that could not be written.
        named = error.filename2 or error.filename
        place = f" ({named})" if named is not None and str(named) != path else ""
        raise StoreError(
            f"{path}: {error.strerror or error}{place}. {todo}. Published results are unchanged."
        ) from error


_WITHOUT_LINKS: Final = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
"""Errors of link() on file systems without hard links."""


_Read = TypeVar("_Read")


@dataclass(frozen=True)
class LocalBlobs:
    """Files below `root`. An existing file was written whole and synced to disk before."""

    root: Path

    @property
    def url(self) -> str:
        """The folder's absolute path."""
        return str(self.root)

    def read(self, path: str) -> bytes | None:
        """See `Blobs`."""
        return self._read(path, lambda file: file.read())

    def read_range(self, path: str, start: int, stop: int) -> bytes | None:
        """See `Blobs`."""

        def read_part(file: FileIO) -> bytes:
            file.seek(start)
            return file.read(stop - start)

        return self._read(path, read_part)

    def digest(self, path: str) -> tuple[int, str] | None:
        """See `Blobs`."""

        def digest_file(file: FileIO) -> tuple[int, str]:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            return file.tell(), sha256

        return self._read(path, digest_file)

    def _read(self, path: str, read: Callable[[FileIO], _Read]) -> _Read | None:
        """Return what `read` returns of the open file; None if there is none."""
        target = self._at(path)
        with storage_errors(str(target)):
            try:
                with target.open("rb", buffering=0) as file:
                    return read(file)
            except (FileNotFoundError, NotADirectoryError):
                return None

    def exists(self, path: str) -> bool:
        """See `Blobs`."""
        with storage_errors(str(self._at(path))):
            return self._at(path).exists()

    def put_new(self, path: str, data: bytes) -> bool:
        """See `Blobs`. A link, unlike a rename, fails if the target exists."""
        target = self._at(path)
        with storage_errors(str(target)), self._temporary(data) as temporary:
            _make_folder(target.parent)
            if not _link_new(temporary, target):
                return False
            _sync_folder(target.parent)
            return True

    def put(self, path: str, data: bytes) -> None:
        """See `Blobs`."""
        target = self._at(path)
        with storage_errors(str(target)), self._temporary(data) as temporary:
            _make_folder(target.parent)
            temporary.replace(target)
            _sync_folder(target.parent)

    def delete(self, path: str) -> None:
        """See `Blobs`."""
        target = self._at(path)
        with storage_errors(str(target)):
            target.unlink(missing_ok=True)

    def delete_tree(self, prefix: str, first: str) -> None:
        """See `Blobs`. One rename hides the whole tree from readers."""
        source = self._at(prefix)
        with storage_errors(str(source)):
            if source.parent != self.root / STAGING:
                _make_folder(self.root / STAGING)
                try:
                    source = source.rename(self.root / STAGING / uuid.uuid4().hex)
                except FileNotFoundError:
                    return
            if source.is_dir():
                shutil.rmtree(source)
            else:
                source.unlink(missing_ok=True)

    def entries(self, prefix: str) -> list[Entry]:
        """See `Blobs`."""
        top = self._at(prefix)
        with storage_errors(str(top)):
            return sorted(_entries_below(str(top), prefix), key=lambda entry: entry.path)

    def marks(self, paths: Sequence[str]) -> list[int]:
        """See `Blobs`."""
        return [changed_at(f"{self.root}/{path}") for path in paths]

    def create_staging(self) -> Path:
        """See `Blobs`. On the project's own file system, so that a rename can publish it."""
        folder = self.root / STAGING / uuid.uuid4().hex
        with storage_errors(str(folder)):
            folder.mkdir(parents=True)
        return folder

    def staged_entries(self) -> list[Entry]:
        """See `Blobs`."""
        top = self.root / STAGING
        with storage_errors(str(top)):
            found = []
            for item in sorted(top.iterdir()) if top.is_dir() else ():
                path = f"{STAGING}/{item.name}"
                there = _entry(item, path)
                if there is not None:
                    inside = self.entries(path) if item.is_dir() else [there]
                    modified = max(entry.modified for entry in (there, *inside))
                    found.append(Entry(path, sum(entry.size for entry in inside), modified))
            return found

    def publish_tree(self, folder: Path, prefix: str, manifest_name: str, manifest: bytes) -> bool:
        """See `Blobs`. All files are durable, manifest last, before one rename publishes them."""
        target = self._at(prefix)
        with storage_errors(str(target)):
            _sync_tree(folder)
            pass_commit_point("during_publish")
            _write_synced(folder / manifest_name, manifest)
            _sync_folder(folder)
            _make_folder(target.parent)
            pass_commit_point("before_commit")
            try:
                folder.rename(target)
            except OSError as error:
                # Renaming onto a folder with content fails: a result is written only once.
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                    return False
                # A network file system repeats a request after a lost reply: the first request has
                # moved our folder, and the second finds none.
                if error.errno not in (errno.ENOENT, errno.ESTALE) or folder.exists():
                    raise
                if self.read(f"{prefix}/{manifest_name}") != manifest:
                    raise
            _sync_folder(target.parent)
            return True

    def _at(self, path: str) -> Path:
        return self.root / checked_path(path)

    @contextmanager
    def _temporary(self, data: bytes) -> Iterator[Path]:
        _make_folder(self.root / STAGING)
        path = self.root / STAGING / uuid.uuid4().hex
        try:
            _write_synced(path, data)
            yield path
        finally:
            path.unlink(missing_ok=True)


def changed_at(path: str) -> int:
    """Return the time of the last change of a file, or of a folder's names [ns]; 0 without one."""
    try:
        return os.stat(path).st_mtime_ns  # noqa: PTH116 (faster than a Path)
    except OSError:
        return 0


def _write_synced(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _link_new(temporary: Path, target: Path) -> bool:
    """Give the whole, synced file `temporary` the name `target`; return False if that exists.

    Of many concurrent attempts exactly one succeeds, and no reader ever sees a part of the file. A
    hard link has this property on most file systems. Without hard links (exFAT, many network
    shares), a rename that never replaces is used. StoreError if the file system has neither.
    """
    try:
        os.link(temporary, target)
    except OSError as error:
        # A network file system repeats a request after a lost reply, and the repeated one finds the
        # link of the first. Nothing else knows the temporary name: two names mean success.
        if temporary.stat().st_nlink == 2:
            return True
        if isinstance(error, FileExistsError):
            return False
        if error.errno not in _WITHOUT_LINKS:
            raise
        return _rename_new(temporary, target, error)
    return True


def _rename_new(temporary: Path, target: Path, no_link: OSError) -> bool:
    """Rename unless `target` exists; return False if it does."""
    no_replace = 1  # RENAME_NOREPLACE of Linux
    here = -100  # AT_FDCWD: a relative path starts at the working folder
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # not Linux
        raise _missing_feature_error(target, no_link) from no_link
    if rename(here, os.fsencode(temporary), here, os.fsencode(target), no_replace) == 0:
        return True
    code = ctypes.get_errno()
    if code == errno.EEXIST:
        return False
    if code == errno.ENOENT and not temporary.exists() and target.exists():
        return True  # the reply was lost, as above
    if code in (errno.EINVAL, errno.ENOSYS, *_WITHOUT_LINKS):
        raise _missing_feature_error(target, no_link) from no_link
    raise OSError(code, os.strerror(code), str(target))


def _missing_feature_error(target: Path, error: OSError) -> StoreError:
    return StoreError(
        f"{target}: the file system has neither hard links ({error.strerror}) nor renames that "
        "never replace a file, so two writers could overwrite each other. Put the project on a "
        "disk that has one of them (ext4, XFS, Btrfs, APFS, NFS; exFAT and SMB on Linux), or in "
        "object storage (s3://bucket/prefix)."
    )


def sync_path(path: Path) -> None:
    """Sync a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    """Sync a folder's entries; some file systems (SMB, FUSE) do that themselves and refuse it."""
    try:
        sync_path(path)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP, errno.ENOSYS):
            raise


def _sync_tree(folder: Path) -> None:
    """Sync all files of a folder, several at a time, then its folders.

    A file system writes one journal entry for calls that wait together: 0.3 s in place of 3.5 s.
    """
    sync_threads = 8  # files that are synced at the same time
    folders, files = [], []
    for inner, _, names in os.walk(folder, topdown=False):
        folders.append(Path(inner))
        files += [Path(inner, name) for name in names]
    with ThreadPoolExecutor(sync_threads) as threads:
        for _ in threads.map(sync_path, files):
            pass
        for _ in threads.map(_sync_folder, folders):
            pass


def _make_folder(path: Path) -> None:
    """Create `path` and its parents so that they survive a power failure."""
    if path.is_dir():
        return
    _make_folder(path.parent)
    path.mkdir(exist_ok=True)
    _sync_folder(path.parent)


def _entries_below(folder: str, path: str) -> Iterator[Entry]:
    """Yield all files below a folder on the disk, without those removed during the scan.

    Their paths begin with `path`, that of the folder below the root.
    """
    try:
        with os.scandir(folder) as found:
            inside = list(found)
    except (FileNotFoundError, NotADirectoryError):
        return
    for each in inside:
        if each.is_dir():
            if not each.is_symlink():
                yield from _entries_below(each.path, f"{path}/{each.name}")
            continue
        entry = _entry(each, f"{path}/{each.name}")
        if entry is not None:
            yield entry


def _entry(file: Path | os.DirEntry[str], path: str) -> Entry | None:
    """Return the entry of a file; None if it was removed since it was listed."""
    try:
        status = os.lstat(file)
    except (FileNotFoundError, NotADirectoryError):
        return None
    return Entry(path, status.st_size, datetime.fromtimestamp(status.st_mtime, UTC))
