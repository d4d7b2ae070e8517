"""Prefect's empty database, made once for each of its versions.

Prefect makes one by a hundred migrations, which takes as long as starting does. All are the same
while they are empty: the first is kept in the user's cache folder (XDG_CACHE_HOME, or ~/.cache),
and new projects begin with a copy.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path

from worldpose.formats import whole_file
from worldpose.store.blobs import storage_errors

DATABASE = "prefect.db"
"""In PREFECT_HOME."""


def begin_database(home: Path) -> bool:
    """Put an empty database into `home`, PREFECT_HOME of a server that is about to start.

    Returns:
        Whether the server is to make the first of its version there, which is then to be kept.

    Raises:
        StoreError: `home` cannot be written to.
    """
    kept = kept_database()
    if (home / DATABASE).exists():
        return False
    if not kept.exists():
        return True
    with storage_errors(str(home / DATABASE)), whole_file(home / DATABASE) as draft:
        try:
            shutil.copyfile(kept, draft)
        except OSError as error:  # a copy names its source first, whichever of them failed
            raise OSError(error.errno, error.strerror) from error
    return False


def keep_database(home: Path) -> None:
    """Keep a copy of what a server has made in `home`, and nobody has used yet."""
    if not (home / DATABASE).exists():
        return  # the environment names another database
    # Where there is no place for it, every project waits for its own.
    with (
        suppress(OSError, sqlite3.Error),
        whole_file(kept_database()) as draft,
        closing(sqlite3.connect(home / DATABASE)) as made,
        closing(sqlite3.connect(draft)) as copy,
    ):
        made.backup(copy)


def kept_database() -> Path:
    """Where the empty database of this Prefect is kept."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    cache = Path(given) if Path(given).is_absolute() else Path("~/.cache").expanduser()
    return cache / "worldpose" / f"prefect-{version('prefect')}.db"
