"""A project in a local folder."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from worldpose.store.blobs import Entry, storage_errors
from worldpose.store.commit_points import reached
from worldpose.store.paths import STAGING, checked_path


@dataclass(frozen=True)
class LocalBlobs:
    """Files below `root`. What exists was written whole and reached the disk first."""

    root: Path

    @property
    def url(self) -> str:
        """The folder's absolute path."""
        return str(self.root)

    def read(self, path: str) -> bytes | None:
        """See `Blobs`."""
        with storage_errors(str(self._at(path))):
            try:
                return self._at(path).read_bytes()
            except (FileNotFoundError, NotADirectoryError):
                return None

    def exists(self, path: str) -> bool:
        """See `Blobs`."""
        with storage_errors(str(self._at(path))):
            return self._at(path).exists()

    def put_new(self, path: str, data: bytes) -> bool:
        """See `Blobs`. A link, unlike a rename, fails where something exists."""
        target = self._at(path)
        with storage_errors(str(target)), self._temporary(data) as temporary:
            _make_folder(target.parent)
            try:
                os.link(temporary, target)
            except FileExistsError:
                return False
            _sync(target.parent)
            return True

    def put(self, path: str, data: bytes) -> None:
        """See `Blobs`."""
        target = self._at(path)
        with storage_errors(str(target)), self._temporary(data) as temporary:
            _make_folder(target.parent)
            temporary.replace(target)
            _sync(target.parent)

    def delete(self, path: str) -> None:
        """See `Blobs`."""
        target = self._at(path)
        with storage_errors(str(target)):
            target.unlink(missing_ok=True)

    def delete_tree(self, prefix: str, first: str) -> None:
        """See `Blobs`. One rename takes the whole tree away from readers."""
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
            files = (
                Path(folder, name)
                for folder, _, names in os.walk(top, onerror=_raise_unless_absent)
                for name in names
            )
            return sorted(filter(None, map(self._entry, files)), key=lambda entry: entry.path)

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
        """See `Blobs`. All is durable, manifest last, before one rename makes it exist."""
        target = self._at(prefix)
        with storage_errors(str(target)):
            _sync_tree(folder)
            reached("during_publish")
            _write(folder / manifest_name, manifest)
            _sync(folder)
            _make_folder(target.parent)
            reached("before_commit")
            try:
                folder.rename(target)
            except OSError as error:
                # Renaming onto a folder with something in it fails: written once, for good.
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                    return False
                raise
            _sync(target.parent)
            return True

    def _at(self, path: str) -> Path:
        return self.root / checked_path(path)

    def _entry(self, path: Path) -> Entry | None:
        """None where somebody has removed it since it was listed."""
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


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_tree(folder: Path) -> None:
    for inner, _, names in os.walk(folder, topdown=False):
        for name in names:
            _sync(Path(inner, name))
        _sync(Path(inner))


def _make_folder(path: Path) -> None:
    """Makes `path` and its parents so that they outlast a power cut."""
    if path.is_dir():
        return
    _make_folder(path.parent)
    path.mkdir(exist_ok=True)
    _sync(path.parent)


def _raise_unless_absent(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error
