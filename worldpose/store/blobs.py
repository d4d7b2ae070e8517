"""Interface of the store to a disk or to object storage."""

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
    """Files by path below one root. Every method raises StoreError if the medium fails."""

    @property
    def url(self) -> str:
        """The root, in the user's notation."""

    def read(self, path: str) -> bytes | None:
        """Return the content at `path`, None if there is none."""

    def exists(self, path: str) -> bool:
        """Return whether `path` exists."""

    def put_new(self, path: str, data: bytes) -> bool:
        """Create `path` whole and durable; return False without a change if it exists."""

    def put(self, path: str, data: bytes) -> None:
        """Replace the content at `path` atomically."""

    def delete(self, path: str) -> None:
        """Remove the file at `path`, if it exists."""

    def delete_tree(self, prefix: str, first: str) -> None:
        """Remove all files below `prefix`; `first` goes first, so that no reader sees a part."""

    def entries(self, prefix: str) -> list[Entry]:
        """Return all files below the folder `prefix`, sorted by path."""

    def staging(self) -> Path:
        """Create a private local folder for a tree to be published."""

    def staged(self) -> list[Entry]:
        """Return the content of this root's staging, with the time of the last write."""

    def publish_tree(self, folder: Path, prefix: str, manifest_name: str, manifest: bytes) -> bool:
        """Publish the files of the staged `folder` at `prefix`, with the manifest last.

        Return False, without a change, if `prefix` is already published.
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
    """Convert the system's errors at `path` to a StoreError that says what to do."""
    try:
        yield
    except OSError as error:
        todo = _TODO.get(error.errno or 0, "Mend that and run again")
        # For a copy or a rename, the second file is the one that could not be written.
        named = error.filename2 or error.filename
        place = f" ({named})" if named is not None and str(named) != path else ""
        raise StoreError(
            f"{path}: {error.strerror or error}{place}. {todo}; published results are untouched."
        ) from error
