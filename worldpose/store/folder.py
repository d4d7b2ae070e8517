"""Project in a local folder."""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from worldpose.errors import StoreError
from worldpose.store.blobs import Entry, storage_errors
from worldpose.store.commit_points import reached
from worldpose.store.paths import STAGING, checked_path

_WITHOUT_LINKS: Final = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
"""Errors of link() on file systems without hard links."""
_HERE: Final = -100
"""AT_FDCWD: a relative path starts at the working folder."""
_NO_REPLACE: Final = 1
"""RENAME_NOREPLACE of Linux."""


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
        target = self._at(path)
        with storage_errors(str(target)):
            try:
                return target.read_bytes()
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
            if not _create_whole(temporary, target):
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

    def staging(self) -> Path:
        """See `Blobs`. On the project's own file system, so that a rename can publish it."""
        folder = self.root / STAGING / uuid.uuid4().hex
        with storage_errors(str(folder)):
            folder.mkdir(parents=True)
        return folder

    def staged(self) -> list[Entry]:
        """See `Blobs`."""
        top = self.root / STAGING
        with storage_errors(str(top)):
            found = []
            for item in sorted(top.iterdir()) if top.is_dir() else ():
                there = self._entry(item)
                if there is None:
                    continue
                inside = self.entries(there.path) if item.is_dir() else [there]
                modified = max(entry.modified for entry in (there, *inside))
                found.append(Entry(there.path, sum(entry.size for entry in inside), modified))
            return found

    def publish_tree(self, folder: Path, prefix: str, manifest_name: str, manifest: bytes) -> bool:
        """See `Blobs`. All files are durable, manifest last, before one rename publishes them."""
        target = self._at(prefix)
        with storage_errors(str(target)):
            _sync_tree(folder)
            reached("during_publish")
            _write(folder / manifest_name, manifest)
            _sync_folder(folder)
            _make_folder(target.parent)
            reached("before_commit")
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

    def _entry(self, path: Path) -> Entry | None:
        """Return the entry; None if it was removed since it was listed."""
        try:
            status = path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        return Entry(
            path.relative_to(self.root).as_posix(),
            status.st_size,
            datetime.fromtimestamp(status.st_mtime, UTC),
        )

    @contextmanager
    def _temporary(self, data: bytes) -> Iterator[Path]:
        _make_folder(self.root / STAGING)
        path = self.root / STAGING / uuid.uuid4().hex
        try:
            _write(path, data)
            yield path
        finally:
            path.unlink(missing_ok=True)


def _write(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _create_whole(temporary: Path, target: Path) -> bool:
    """Give the whole, synced file `temporary` the name `target`; return False if that exists.

    Of many concurrent attempts exactly one succeeds, and no reader ever sees a part of the file. A
    hard link has this property on most file systems. Without hard links (exFAT, many network
    shares), a rename that never replaces is used.

    Raises:
        StoreError: the file system supports neither.
        OSError: it failed for another reason.
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
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # not Linux
        raise _unfit(target, no_link) from no_link
    arguments = (_HERE, os.fsencode(temporary), _HERE, os.fsencode(target), _NO_REPLACE)
    if rename(*arguments) == 0:
        return True
    code = ctypes.get_errno()
    if code == errno.EEXIST:
        return False
    if code == errno.ENOENT and not temporary.exists() and target.exists():
        return True  # the reply was lost, as above
    if code in (errno.EINVAL, errno.ENOSYS, *_WITHOUT_LINKS):
        raise _unfit(target, no_link) from no_link
    raise OSError(code, os.strerror(code), str(target))


def _unfit(target: Path, error: OSError) -> StoreError:
    return StoreError(
        f"{target}: the file system has neither hard links ({error.strerror}) nor renames that "
        "never replace a file, so two writers could overwrite each other. Put the project on a "
        "disk that has one of them (ext4, XFS, Btrfs, APFS, NFS; exFAT and SMB on Linux), or in "
        "object storage (s3://bucket/prefix)."
    )


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    """Sync a folder's entries; some file systems (SMB, FUSE) do that themselves and refuse it."""
    try:
        _sync(path)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP, errno.ENOSYS):
            raise


def _sync_tree(folder: Path) -> None:
    for inner, _, names in os.walk(folder, topdown=False):
        for name in names:
            _sync(Path(inner, name))
        _sync_folder(Path(inner))


def _make_folder(path: Path) -> None:
    """Create `path` and its parents so that they survive a power failure."""
    if path.is_dir():
        return
    _make_folder(path.parent)
    path.mkdir(exist_ok=True)
    _sync_folder(path.parent)


def _entries_below(folder: str, path: str) -> Iterator[Entry]:
    """Yield all files below a folder, without those removed during the scan.

    Args:
        folder: path on the disk.
        path: path below the root.
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
        try:
            status = each.stat(follow_symlinks=False)
        except (FileNotFoundError, NotADirectoryError):
            continue
        modified = datetime.fromtimestamp(status.st_mtime, UTC)
        yield Entry(f"{path}/{each.name}", status.st_size, modified)
