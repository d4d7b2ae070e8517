"""What the store asks of a disk or of object storage, and nothing more."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Protocol

from worldpose.errors import StoreError


@dataclass(frozen=True)
class Entry:
    """One file or object."""

    path: str
    """Relative to the root."""
    size: int
    """[byte]"""
    modified: datetime


class Blobs(Protocol):
    """Files by path below one root. Every method raises StoreError when the medium fails."""

    @property
    def url(self) -> str:
        """The root, as a user names it."""

    def read(self, path: str) -> bytes | None:
        """The content at `path`, None when nothing is there."""

    def exists(self, path: str) -> bool:
        """Is something at `path`."""

    def put_new(self, path: str, data: bytes) -> bool:
        """Creates `path` whole and durable, or changes nothing and is False: it exists."""

    def put(self, path: str, data: bytes) -> None:
        """Replaces the content at `path` in one step."""

    def delete(self, path: str) -> None:
        """Removes the file at `path`; fine when there is none."""

    def delete_tree(self, prefix: str, first: str) -> None:
        """Removes all below `prefix`; `first` goes first, so that no reader sees a half."""

    def entries(self, prefix: str) -> list[Entry]:
        """All files below the folder `prefix`, sorted by path."""

    def staging(self) -> Path:
        """A new private local folder from which a tree can be published."""

    def staged(self) -> list[Entry]:
        """What lies in this root's staging, with the time it was last written to."""

    def publish_tree(self, folder: Path, prefix: str, manifest_name: str, manifest: bytes) -> bool:
        """Makes the files of the staged `folder` exist at `prefix`, with the manifest last.

        False when something is published there already; nothing is changed then.
        """


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
    """Turns the system's errors at `path` into a StoreError that says what to do."""
    try:
        yield
    except OSError as error:
        todo = _TODO.get(error.errno or 0, "Mend that and run again")
        # Of a copy or a rename, the second file is the one that could not be written.
        named = error.filename2 or error.filename
        place = f" ({named})" if named is not None and str(named) != path else ""
        raise StoreError(
            f"{path}: {error.strerror or error}{place}. {todo}; published results are untouched."
        ) from error
