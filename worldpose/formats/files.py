"""Atomic writing of files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a draft's path that becomes `path` in one step when the block succeeds.

    The draft is in the same folder and is synced to disk; a block that raises, or a killed process,
    leaves the previous content of `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as workshop:
        # In a subfolder: a temporary folder is private, but the file gets the usual permissions.
        draft = Path(workshop) / path.name
        yield draft
        _sync(draft)
        draft.replace(path)
    _sync(path.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
